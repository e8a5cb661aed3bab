//! Which values of parameters are not shown: passwords and the like belong neither on a page nor in a terminal.

use std::str::FromStr;

use regex::{Regex, RegexBuilder};

use crate::xmlrpc::{Struct, Value};

/// The names whose values are hidden unless others are given.
pub const DEFAULT: &str =
    "password|passwd|passphrase|pwd|token|secret|key|credential|private|(^|[^a-z])pin([^a-z]|$)";
/// Stands where a value is hidden.
pub const HIDDEN: &str = "(hidden)";

/// The parameters whose values are hidden, by their full names.
#[derive(Clone, Debug)]
pub struct Hide(Option<Regex>);

/// From a regular expression that ignores case. The empty one hides nothing.
impl FromStr for Hide {
    type Err = String;

    fn from_str(pattern: &str) -> Result<Self, String> {
        if pattern.is_empty() {
            return Ok(Self(None));
        }
        let regex = RegexBuilder::new(pattern).case_insensitive(true).build();
        // Its first lines are a picture of the place.
        let why = |error: regex::Error| error.to_string().lines().last().unwrap_or("").to_owned();
        regex.map(|regex| Self(Some(regex))).map_err(why)
    }
}

impl Hide {
    /// Whether the value of the parameter `name`, as in `/robot/wifi/password`, is hidden: its own name says
    /// so, or that of a namespace above it.
    pub fn hides(&self, name: &str) -> bool {
        let above = name.match_indices('/').map(|(end, _)| end).skip(1);
        let mut names = above.filter_map(|end| name.get(..end)).chain([name]);
        names.any(|name| self.matches(name))
    }

    /// `value` of the parameter `name` with [`HIDDEN`] in place of what is hidden of it, which may be a part:
    /// members of structs have names of their own, also in lists. The root is called ``.
    pub fn mask(&self, name: &str, value: &Value) -> Value {
        self.mask_below(name, value, self.hides(name))
    }

    /// [`mask`](Self::mask) for the whole tree of parameters.
    pub fn mask_tree(&self, tree: &Struct) -> Struct {
        let members = tree.iter().map(|(key, value)| {
            let shown = self.mask(&format!("/{key}"), value);
            (key.clone(), shown)
        });
        members.collect()
    }

    /// [`mask`](Self::mask), if it is known whether `name` is hidden.
    fn mask_below(&self, name: &str, value: &Value, hidden: bool) -> Value {
        match value {
            Value::Struct(members) if !members.is_empty() => {
                let members = members.iter().map(|(key, value)| {
                    let name = format!("{name}/{key}");
                    let shown = self.mask_below(&name, value, hidden || self.matches(&name));
                    (key.clone(), shown)
                });
                Value::Struct(members.collect())
            }
            _ if hidden => HIDDEN.into(),
            Value::Array(elements) => {
                let elements = elements.iter();
                Value::Array(
                    elements
                        .map(|it| self.mask_below(name, it, false))
                        .collect(),
                )
            }
            _ => value.clone(),
        }
    }

    fn matches(&self, name: &str) -> bool {
        self.0.as_ref().is_some_and(|regex| regex.is_match(name))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn tree(members: &[(&str, Value)]) -> Value {
        let members = members.iter().cloned();
        Value::Struct(
            members
                .map(|(key, value)| (key.to_owned(), value))
                .collect(),
        )
    }

    #[test]
    fn by_default_passwords_and_the_like_are_hidden_wherever_they_are() {
        let hide: Hide = DEFAULT.parse().unwrap();
        for name in ["/wifi/password", "/API_Key", "/secrets/user", "/a/tokens"] {
            assert!(hide.hides(name), "{name}");
        }
        for name in [
            "/wifi/passwd",
            "/db/pwd",
            "/cloud_credentials",
            "/sim_PIN",
            "/pin",
            "/a/pin/b",
            "/privateer",
        ] {
            assert!(hide.hides(name), "{name}");
        }
        for name in [
            "/robot/wheels",
            "/spinning",
            "/pinion/speed",
            "/mapping",
            "/pwm",
        ] {
            assert!(!hide.hides(name), "{name}");
        }
        let hide: Hide = "^/wifi$".parse().unwrap();
        assert!(hide.hides("/wifi/user") && hide.hides("/wifi") && !hide.hides("/wifi2/user"));
        let hide: Hide = DEFAULT.parse().unwrap();
        let login = tree(&[("user", "me".into()), ("Password", "1".into())]);
        let given = tree(&[
            ("wheels", 4.into()),
            ("wifi", login.clone()),
            ("logins", Value::Array(vec![login, 7.into()])),
            ("secret", tree(&[("a", 1.into()), ("b", tree(&[]))])),
        ]);
        let shown = tree(&[("user", "me".into()), ("Password", HIDDEN.into())]);
        let expected = tree(&[
            ("wheels", 4.into()),
            ("wifi", shown.clone()),
            ("logins", Value::Array(vec![shown, 7.into()])),
            (
                "secret",
                tree(&[("a", HIDDEN.into()), ("b", HIDDEN.into())]),
            ),
        ]);
        assert_eq!(hide.mask("", &given), expected);
    }

    #[test]
    fn the_empty_expression_hides_nothing_and_a_bad_one_is_refused() {
        let hide: Hide = "".parse().unwrap();
        assert!(!hide.hides("/password"));
        let error = "a(b".parse::<Hide>().unwrap_err();
        assert_eq!(error, "error: unclosed group");
    }
}
