//! Decides which parameter values are hidden. Passwords and the like must not appear on a page or in a terminal.
//!
//! What shows values to people or other programs takes a [`Masked`] value, and only [`Hide`] makes one. So no output can
//! forget the rule.

mod json;

use std::{borrow::Cow, str::FromStr};

use regex::{Regex, RegexBuilder};

use ros1_master::xmlrpc::{Struct, Value};

/// Regular expression for the parameter names whose values are hidden by default.
pub const DEFAULT: &str =
    "password|passwd|passphrase|pwd|token|secret|key|credential|private|(^|[^a-z])pin([^a-z]|$)";
/// The text that is shown in place of a hidden value.
pub const HIDDEN: &str = "(hidden)";

/// Chooses the parameters with hidden values by their full names.
#[derive(Clone, Debug)]
pub struct Hide(Option<Regex>);

/// A parameter's value without what is hidden in it. It is written as JSON, and as text by
/// [`shown`](crate::checkpoint::format::shown).
#[derive(Clone, Debug, PartialEq)]
pub struct Masked<'a>(Cow<'a, Value>);

impl Masked<'_> {
    pub fn value(&self) -> &Value {
        &self.0
    }

    /// The members of a struct that is not empty, each masked. `None` for any other value.
    pub fn members(&self) -> Option<impl Iterator<Item = (&str, Masked<'_>)>> {
        let members = match self.value() {
            Value::Struct(members) if !members.is_empty() => members,
            _ => return None,
        };
        let members = members.iter();
        Some(members.map(|(key, value)| (key.as_str(), Masked(Cow::Borrowed(value)))))
    }
}

/// Parses a regular expression, which ignores case. An empty one hides nothing.
impl FromStr for Hide {
    type Err = String;

    fn from_str(pattern: &str) -> Result<Self, String> {
        if pattern.is_empty() {
            return Ok(Self(None));
        }
        let regex = RegexBuilder::new(pattern).case_insensitive(true).build();
        // The first lines of regex's error only mark the position.
        let why = |error: regex::Error| error.to_string().lines().last().unwrap_or("").to_owned();
        regex.map(|regex| Self(Some(regex))).map_err(why)
    }
}

impl Hide {
    /// Whether the value of the parameter `name`, such as `/robot/wifi/password`, is hidden. The value is hidden if the
    /// regular expression matches `name` or the name of a namespace above it.
    pub fn hides(&self, name: &str) -> bool {
        let above = name.match_indices('/').map(|(end, _)| end).skip(1);
        let mut names = above.filter_map(|end| name.get(..end)).chain([name]);
        names.any(|name| self.matches(name))
    }

    /// Hides nothing.
    pub fn nothing() -> Self {
        Self(None)
    }

    /// The `value` of the parameter `name`, with [`HIDDEN`] in place of each hidden part. Each member of a struct has
    /// its own name and is judged by it, also inside lists. The name of the whole tree is the empty string.
    pub fn mask<'a>(&self, name: &str, value: &'a Value) -> Masked<'a> {
        Masked(self.mask_below(name, value, self.hides(name)))
    }

    /// Masks the whole parameter tree like [`mask`](Self::mask).
    pub fn mask_tree(&self, tree: &Struct) -> Masked<'static> {
        let members = tree.iter().map(|(key, value)| {
            let shown = self.mask(&format!("/{key}"), value).0;
            (key.clone(), shown.into_owned())
        });
        Masked(Cow::Owned(Value::Struct(members.collect())))
    }

    /// Does the same as [`mask`](Self::mask) for a caller that already knows whether `name` is hidden.
    fn mask_below<'a>(&self, name: &str, value: &'a Value, hidden: bool) -> Cow<'a, Value> {
        match value {
            Value::Struct(members) if !members.is_empty() => {
                let members = members.iter().map(|(key, value)| {
                    let name = format!("{name}/{key}");
                    let hidden = hidden || self.matches(&name);
                    let shown = self.mask_below(&name, value, hidden);
                    (key.clone(), shown.into_owned())
                });
                Cow::Owned(Value::Struct(members.collect()))
            }
            _ if hidden => Cow::Owned(HIDDEN.into()),
            Value::Array(elements) => {
                let elements = elements.iter();
                let shown = elements.map(|it| self.mask_below(name, it, false).into_owned());
                Cow::Owned(Value::Array(shown.collect()))
            }
            _ => Cow::Borrowed(value),
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
    fn passwords_and_the_like_are_hidden_by_default_at_every_level() {
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
        assert_eq!(*hide.mask("", &given).value(), expected);
    }

    #[test]
    fn an_empty_expression_hides_nothing_and_an_invalid_one_is_refused() {
        let hide: Hide = "".parse().unwrap();
        assert!(!hide.hides("/password"));
        let error = "a(b".parse::<Hide>().unwrap_err();
        assert_eq!(error, "error: unclosed group");
    }
}
