//! A collection with lookup by topic, parameter or node name.

use std::{
    collections::{BTreeMap, HashMap},
    ops::Bound,
};

use super::Subject;

/// Values by [`Subject`]: topic, parameter or node name. A parameter is also found by the keys above and below its own.
#[derive(Debug)]
pub struct BySubject<T> {
    exact: HashMap<Subject, Vec<T>>,
    params: BTreeMap<String, Vec<T>>,
}

impl<T> Default for BySubject<T> {
    fn default() -> Self {
        Self {
            exact: HashMap::new(),
            params: BTreeMap::new(),
        }
    }
}

impl<T: Copy + PartialEq> BySubject<T> {
    pub fn add(&mut self, subject: &Subject, thing: T) {
        match subject {
            Subject::Param(key) => match self.params.get_mut(key) {
                Some(things) => things.push(thing),
                None => {
                    self.params.insert(key.clone(), vec![thing]);
                }
            },
            _ => self.exact.entry(subject.clone()).or_default().push(thing),
        }
    }

    pub fn remove(&mut self, subject: &Subject, thing: T) {
        let things = match subject {
            Subject::Param(key) => self.params.get_mut(key),
            _ => self.exact.get_mut(subject),
        };
        let Some(things) = things else { return };
        things.retain(|other| *other != thing);
        if things.is_empty() {
            match subject {
                Subject::Param(key) => self.params.remove(key),
                _ => self.exact.remove(subject),
            };
        }
    }

    /// The values of all subjects that [concern](Subject::concerns) `subject`.
    pub fn about<'a>(&'a self, subject: &'a Subject) -> impl Iterator<Item = T> + 'a {
        let (exact, key) = match subject {
            Subject::Param(key) => (None, Some(key.as_str())),
            _ => (self.exact.get(subject), None),
        };
        let key = key.filter(|_| !self.params.is_empty());
        let above_or_equal = key.into_iter().flat_map(|key| {
            let ends = key.match_indices('/');
            ends.filter_map(|(end, _)| self.params.get(key.get(..=end)?))
        });
        let below = key.into_iter().flat_map(|key| {
            let after = (Bound::Excluded(key), Bound::Unbounded);
            let below = self.params.range::<str, _>(after);
            below
                .take_while(move |(other, _)| other.starts_with(key))
                .map(|(_, things)| things)
        });
        let all = exact.into_iter().chain(above_or_equal).chain(below);
        all.flatten().copied()
    }

    pub fn is_empty(&self) -> bool {
        self.exact.is_empty() && self.params.is_empty()
    }

    /// Whether [`Self::about`] finds any value.
    pub fn has(&self, subject: &Subject) -> bool {
        self.about(subject).next().is_some()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn param(key: &str) -> Subject {
        Subject::Param(key.to_owned())
    }

    #[test]
    fn a_parameter_is_found_by_the_keys_above_and_below_it() {
        let mut things = BySubject::default();
        for (number, key) in ["/", "/a/", "/a/b/", "/a/b/c/", "/ab/"].iter().enumerate() {
            things.add(&param(key), number);
        }
        let about = |key: &str| things.about(&param(key)).collect::<Vec<_>>();
        assert_eq!(about("/a/b/"), [0, 1, 2, 3]);
        assert_eq!(about("/ab/"), [0, 4]);
        assert_eq!(about("/x/"), [0]);
        assert_eq!(about("/"), [0, 1, 2, 3, 4]);
    }

    #[test]
    fn removed_things_are_gone_and_a_topic_is_no_parameter_of_the_same_name() {
        let mut things = BySubject::default();
        let topic = Subject::Topic("/a/".to_owned());
        things.add(&topic, 1);
        things.add(&topic, 2);
        assert!(!things.has(&param("/a/")));
        things.remove(&topic, 1);
        assert_eq!(things.about(&topic).collect::<Vec<_>>(), [2]);
        things.remove(&topic, 2);
        assert!(!things.has(&topic));
        things.add(&param("/a/"), 3);
        things.remove(&param("/a/"), 3);
        assert!(!things.has(&param("/")));
    }
}
