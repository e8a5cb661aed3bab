//! The parameter server, as in `rosmaster/paramserver.py`.

use super::api::Failure;
use super::names;
use super::registry::Registrations;
use super::updates::{GONE, Update, updates};
use crate::xmlrpc::{Struct, Value};

/// Maximum number of levels of the parameter tree that are kept. Values below that become nil, which limits recursion
/// over the tree, including when it is dropped. rosmaster accepts any depth, through long keys or deep values, but
/// returns at most 491 levels at once. It does return deeper values for a key that leads close enough to them, but
/// these values could not be restored in another master anyway.
const DEEPEST_TREE: usize = 512;

#[derive(Clone, Default)]
pub(crate) struct Params {
    tree: Struct,
    /// Whether any value was too deep for [`DEEPEST_TREE`] and became nil.
    cut: bool,
    /// The results of the running multicall that are dicts of the tree itself; see [`Live`].
    live: Vec<Live>,
}

/// A result of a multicall that is a dict of the parameter tree itself. rosmaster's `getParam` returns the
/// tree's own dict, and a multicall encodes its results only after its last entry has run, so a later
/// `setParam` below that dict shows in the earlier result.
#[derive(Clone)]
struct Live {
    /// The place of the dict in the multicall's result.
    at: Vec<usize>,
    path: Vec<String>,
    /// The value that the dict had when it was removed from the tree. `None` while it is in the tree.
    detached: Option<Value>,
}

enum Found<'a> {
    Tree(&'a Struct),
    Value(&'a Value),
}

impl Found<'_> {
    fn to_value(&self) -> Value {
        match self {
            Self::Tree(tree) => Value::Struct((*tree).clone()),
            Self::Value(value) => (*value).clone(),
        }
    }
}

impl Params {
    pub(crate) fn new(tree: Struct) -> Self {
        Self {
            tree,
            ..Self::default()
        }
    }

    pub(crate) fn tree(&self) -> &Struct {
        &self.tree
    }

    pub(crate) fn is_cut(&self) -> bool {
        self.cut
    }

    pub(crate) fn get(&self, key: &str) -> Option<Value> {
        Some(self.find(read_path(key))?.to_value())
    }

    pub(crate) fn has(&self, key: &str) -> bool {
        self.find(read_path(key)).is_some()
    }

    /// The value that [`Self::set`] would replace and [`Self::delete`] delete. Unlike reads, they do not require a
    /// leading slash.
    pub(crate) fn written(&self, key: &str) -> Option<Value> {
        Some(self.find(names::parts(key))?.to_value())
    }

    fn find<'k>(&self, path: impl Iterator<Item = &'k str>) -> Option<Found<'_>> {
        let mut found = Found::Tree(&self.tree);
        for part in path {
            let members = match found {
                Found::Tree(tree) => tree,
                Found::Value(value) => value.as_struct()?,
            };
            found = Found::Value(members.get(part)?);
        }
        Some(found)
    }

    /// rosmaster's `set_param`, for a key with a trailing slash. Returns the `paramUpdate`s to send. The tree changes
    /// even if they cannot be computed. The node `ignored` gets none for `key` itself.
    pub(crate) fn set<'a>(
        &mut self,
        key: &'a str,
        value: &'a Value,
        ignored: Option<&'a str>,
        subscribers: &'a Registrations,
    ) -> Result<Vec<Update<'a>>, Failure> {
        if key == "/" {
            let Value::Struct(_) = value else {
                return Err(Failure::Type(
                    "cannot set root of parameter tree to non-dictionary",
                ));
            };
        }
        let updates = updates(subscribers, key, value, ignored);
        let path: Vec<&str> = names::parts(key).take(DEEPEST_TREE + 1).collect();
        self.detach(&path);
        self.put(&path, value.clone())?;
        updates
    }

    /// Sets a value and creates the namespaces on the way to it. Values below level [`DEEPEST_TREE`] become nil.
    pub(crate) fn put(&mut self, path: &[&str], value: Value) -> Result<(), Failure> {
        let path = path.get(..DEEPEST_TREE).unwrap_or(path);
        let levels = DEEPEST_TREE - path.len();
        let fits = levels > 0 && !is_deeper(&value, levels);
        self.cut |= !fits;
        let value = match levels {
            0 => Value::Nil,
            _ if fits => value,
            _ => cut(value, levels),
        };
        match (path.split_last(), value) {
            (None, Value::Struct(tree)) => self.tree = tree,
            (None, _) => return Err(Failure::Internal("list index out of range")),
            (Some((last, namespaces)), value) => {
                let tree = Some(&mut self.tree);
                let members = namespaces
                    .iter()
                    .fold(tree, |members, name| namespace(members?, name));
                if let Some(members) = members {
                    members.insert((*last).to_owned(), value);
                }
            }
        }
        Ok(())
    }

    /// rosmaster's `delete_param`, for a key with a trailing slash. `None` if the parameter is not set.
    pub(crate) fn delete<'a>(
        &mut self,
        key: &'a str,
        subscribers: &'a Registrations,
    ) -> Result<Option<Vec<Update<'a>>>, Failure> {
        let path: Vec<&str> = names::parts(key).collect();
        let Some((last, namespaces)) = path.split_last() else {
            return Ok(None);
        };
        let holds = match self.find(namespaces.iter().copied()) {
            None => false,
            Some(Found::Tree(members) | Found::Value(Value::Struct(members))) => {
                members.contains_key(*last)
            }
            // rosmaster uses Python's `in`, which also finds a substring of a string or an element of a list. Deleting
            // it then raises a `TypeError`.
            Some(Found::Value(Value::String(text))) if !text.contains(*last) => false,
            Some(Found::Value(Value::Array(elements))) if !elements.iter().any(is(last)) => false,
            Some(Found::Value(_)) => return Err(Failure::Type("this parameter is no namespace")),
        };
        if !holds {
            return Ok(None);
        }
        self.detach(&path);
        let mut members = &mut self.tree;
        for namespace in namespaces {
            let Some(Value::Struct(inner)) = members.get_mut(*namespace) else {
                return Ok(None);
            };
            members = inner;
        }
        members.shift_remove(*last);
        updates(subscribers, key, &GONE, None).map(Some)
    }

    /// rosmaster's `search_param`.
    pub(crate) fn search(&self, namespace: &str, key: &str) -> Result<Option<String>, Failure> {
        if key.starts_with('~') {
            return Err(Failure::Internal("invalid key"));
        }
        if !namespace.starts_with('/') {
            return Err(Failure::Internal("namespace must be global"));
        }
        if key.starts_with('/') {
            return Ok(self.has(key).then(|| key.to_owned()));
        }
        // rosmaster requires only the first part of the key to exist.
        let Some(first) = names::parts(key).next() else {
            return Ok(None);
        };
        if self.has(&names::join(namespace, first)) {
            return Ok(Some(names::join(namespace, key)));
        }
        let mut upwards: Vec<&str> = names::parts(namespace).collect();
        while upwards.pop().is_some() {
            let prefix: String = upwards.iter().flat_map(|part| ["/", part]).collect();
            if self.has(&format!("{prefix}/{first}")) {
                return Ok(Some(format!("{prefix}/{key}")));
            }
        }
        Ok(None)
    }

    /// rosmaster's `get_param_names`: every key whose value is not a dict.
    pub(crate) fn names(&self) -> Vec<String> {
        fn collect(key: &str, members: &Struct, found: &mut Vec<String>) {
            for (name, value) in members {
                let key = names::join(key, name);
                match value {
                    Value::Struct(inner) => collect(&key, inner, found),
                    _ => found.push(key),
                }
            }
        }
        let mut found = Vec::new();
        collect("/", &self.tree, &mut found);
        found
    }

    /// Number of parameters, not counting namespaces.
    pub(crate) fn leaves(&self) -> usize {
        fn count(members: &Struct) -> usize {
            let leaves = members.values().map(|value| match value {
                Value::Struct(inner) => count(inner),
                _ => 1,
            });
            leaves.sum()
        }
        count(&self.tree)
    }

    /// Notes that the result of the running multicall contains the dict under `key`, at the position `at`.
    pub(crate) fn watch(&mut self, key: &str, at: Vec<usize>) {
        self.live.push(Live {
            at,
            path: read_path(key).map(str::to_owned).collect(),
            detached: None,
        });
    }

    /// The dicts noted during the multicall, with their values at its end and their positions in its result.
    pub(crate) fn take_watched(&mut self) -> Vec<(Vec<usize>, Value)> {
        let live = std::mem::take(&mut self.live);
        live.into_iter()
            .filter_map(|live| {
                let value = live.detached.or_else(|| {
                    let found = self.find(live.path.iter().map(String::as_str))?;
                    Some(found.to_value())
                })?;
                Some((live.at, value))
            })
            .collect()
    }

    /// Keeps the values of the dicts noted by [`Self::watch`] at `path` and below, because the caller is about to
    /// remove these dicts from the tree.
    fn detach(&mut self, path: &[&str]) {
        let mut live = std::mem::take(&mut self.live);
        for entry in &mut live {
            let below =
                entry.path.len() >= path.len() && path.iter().zip(&entry.path).all(|(a, b)| a == b);
            if below && entry.detached.is_none() {
                let found = self.find(entry.path.iter().map(String::as_str));
                entry.detached = found.map(|found| found.to_value());
            }
        }
        self.live = live;
    }
}

/// The namespace `name` in `members`, created if needed. Replaces a value that is not a namespace.
/// Always `Some`, although the type of a value does not show that.
fn namespace<'t>(members: &'t mut Struct, name: &str) -> Option<&'t mut Struct> {
    let value = members.entry(name.to_owned()).or_insert(Value::Nil);
    if !matches!(value, Value::Struct(_)) {
        *value = Value::Struct(Struct::new());
    }
    match value {
        Value::Struct(inner) => Some(inner),
        _ => None,
    }
}

/// Whether a list's element equals `name`, as Python compares them.
fn is(name: &str) -> impl Fn(&Value) -> bool {
    move |value| matches!(value, Value::String(text) | Value::DateTime(text) if text == name)
}

/// Whether arrays and structs are nested more than `levels` deep.
fn is_deeper(value: &Value, levels: usize) -> bool {
    match value {
        Value::Array(_) | Value::Struct(_) if levels == 0 => true,
        Value::Array(elements) => elements.iter().any(|value| is_deeper(value, levels - 1)),
        Value::Struct(members) => members.values().any(|value| is_deeper(value, levels - 1)),
        _ => false,
    }
}

/// Replaces arrays and structs that are more than `levels` deep by nil.
fn cut(value: Value, levels: usize) -> Value {
    match value {
        Value::Array(_) | Value::Struct(_) if levels == 0 => Value::Nil,
        Value::Array(elements) => Value::Array(
            elements
                .into_iter()
                .map(|value| cut(value, levels - 1))
                .collect(),
        ),
        Value::Struct(members) => {
            let members = members.into_iter();
            Value::Struct(
                members
                    .map(|(key, value)| (key, cut(value, levels - 1)))
                    .collect(),
            )
        }
        value => value,
    }
}

/// The path that rosmaster's `get_param` follows. It ignores everything before the first slash.
fn read_path(key: &str) -> impl Iterator<Item = &str> {
    key.split('/').skip(1).filter(|part| !part.is_empty())
}
