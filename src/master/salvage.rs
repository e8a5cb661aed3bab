//! Reading the parameters of a master that cannot return them all at once.

use indexmap::IndexSet;

use super::CALLER_ID;
use super::params::Params;
use super::{multicall, python};
use crate::xmlrpc::{Call, Reply, Struct, Value};

/// The names that lead to a parameter.
type Path = Vec<String>;

/// What rosmaster says of a parameter that is a nil itself.
const NONE_RETURNED: &str = "Internal error (None value returned)";

/// The parameters of a master that holds one which it cannot return, read part by part.
///
/// Such a parameter spoils every namespace around it, so a namespace that cannot be read is entered,
/// and what else is in it is read without it: all at once first, then each half, and so on. What
/// cannot be read is taken from what was known before, and if nothing was known, a nil stands for it,
/// which can be returned as little.
///
/// An empty namespace beside the culprit that was not known before stays unknown: `getParamNames`
/// does not name it.
#[derive(Clone)]
pub struct Salvage<'a> {
    /// Keys of all leaves, without the leading slash.
    leaves: IndexSet<String>,
    /// What was known before.
    previous: &'a Struct,
    /// Paths still to be asked for, those that are asked for together in one list, the next list last.
    open: Vec<Vec<Path>>,
    /// What has been read.
    found: Params,
    unknown: Vec<String>,
}

impl<'a> Salvage<'a> {
    /// The question for the names of all parameters. They can always be returned.
    pub fn names() -> Call {
        Call::new("getParamNames", vec![CALLER_ID.into()])
    }

    /// Begins with the reply to [`Salvage::names`]; none if it is not that of a master.
    pub fn new(names: &Reply, previous: &'a Struct) -> Option<Self> {
        let Reply::Value(Value::Array(fields)) = names else {
            return None;
        };
        let names = fields.get(2)?.as_array()?;
        let leaf = |name: &Value| Some(name.as_str()?.trim_start_matches('/').to_owned());
        let mut salvage = Self {
            leaves: names.iter().map(leaf).collect::<Option<_>>()?,
            previous,
            open: Vec::new(),
            found: Params::new(Struct::new()),
            unknown: Vec::new(),
        };
        salvage.enter(&[]);
        Some(salvage)
    }

    /// What to ask next.
    pub fn question(&mut self) -> Option<Call> {
        while let Some(paths) = self.open.pop_if(|paths| !paths.iter().all(is_speakable)) {
            for path in &paths {
                self.keep(path);
            }
        }
        let get = |path: &Path| Call::new("getParam", vec![CALLER_ID.into(), key(path).into()]);
        match self.open.last()?.as_slice() {
            [path] => Some(get(path)),
            paths => Some(Call::multicall(paths.iter().map(get))),
        }
    }

    /// Takes in the reply to [`Salvage::question`], none if it was no XML-RPC. A key that vanished
    /// meanwhile is left out.
    pub fn take(&mut self, reply: Option<&Reply>) {
        let Some(mut paths) = self.open.pop() else {
            return;
        };
        match (paths.as_slice(), reply) {
            ([path], reply) => self.take_one(path, reply),
            (_, Some(Reply::Value(Value::Array(results)))) if results.len() == paths.len() => {
                for (path, result) in paths.iter().zip(results) {
                    self.take_one(path, multicall::entry_reply(result).as_ref());
                }
            }
            // One of them spoils the reply.
            _ => {
                let second_half = paths.split_off(paths.len() / 2);
                self.open.extend([second_half, paths]);
            }
        }
    }

    fn take_one(&mut self, path: &[String], reply: Option<&Reply>) {
        if let Some(Reply::Value(Value::Array(fields))) = reply {
            match fields.as_slice() {
                [Value::Int(1), _, value] => self.put(path, value.clone()),
                [_, Value::String(message), _] if message == NONE_RETURNED => {
                    self.put(path, Value::Nil);
                }
                _ => {}
            }
        } else if self.leaves.contains(&path.join("/")) || !self.enter(path) {
            self.keep(path);
        }
    }

    /// What the master holds as far as that is known, and the keys of what was neither read nor known.
    pub fn finish(self) -> (Struct, Vec<String>) {
        (self.found.into_tree(), self.unknown)
    }

    fn put(&mut self, path: &[String], value: Value) {
        let path: Vec<&str> = path.iter().map(String::as_str).collect();
        // It fails only for the whole tree, which is never asked for.
        let _ = self.found.put(&path, value);
    }

    /// What was known of something that cannot be read.
    fn keep(&mut self, path: &[String]) {
        let value = match self.known(path) {
            Some(value) => value.clone(),
            None => {
                self.unknown.push(key(path));
                Value::Nil
            }
        };
        self.put(path, value);
    }

    fn known(&self, path: &[String]) -> Option<&'a Value> {
        let (last, namespaces) = path.split_last()?;
        self.known_members(namespaces)?.get(last)
    }

    fn known_members(&self, path: &[String]) -> Option<&'a Struct> {
        let mut names = path.iter();
        names.try_fold(self.previous, |members, name| {
            members.get(name)?.as_struct()
        })
    }

    /// Asks for each thing directly in the namespace, in order; false if there is nothing in it.
    ///
    /// The order is that of the master's names. What only we know is asked for as well, behind what
    /// is before it with us.
    fn enter(&mut self, path: &[String]) -> bool {
        let mut prefix = path.join("/");
        if !prefix.is_empty() {
            prefix.push('/');
        }
        let below = self
            .leaves
            .iter()
            .filter_map(|leaf| leaf.strip_prefix(prefix.as_str()));
        let first = below.filter_map(|rest| rest.split('/').next());
        let mut inside: IndexSet<&str> = first.filter(|name| !name.is_empty()).collect();
        let mut behind = 0;
        for name in self.known_members(path).into_iter().flat_map(Struct::keys) {
            match inside.get_index_of(name.as_str()) {
                Some(at) => behind = at + 1,
                None => {
                    inside.shift_insert(behind, name);
                    behind += 1;
                }
            }
        }
        let inside: Vec<Path> = inside
            .into_iter()
            .map(|name| [path, &[name.to_owned()]].concat())
            .collect();
        if inside.is_empty() {
            return false;
        }
        if !path.is_empty() {
            self.put(path, Value::Struct(Struct::new()));
        }
        // What was known to spoil a reply spoils no other's.
        let is_alone = |path: &Path| {
            let known = self.known(path);
            !is_speakable(path) || known.is_some_and(|value| !python::is_readable(value))
        };
        let together = inside.chunk_by(|a, b| !is_alone(a) && !is_alone(b));
        let together: Vec<Vec<Path>> = together.map(<[Path]>::to_vec).collect();
        self.open.extend(together.into_iter().rev());
        true
    }
}

/// Whether a key can lead there: a name with a slash, as a member of a struct may have it, leads
/// elsewhere.
fn is_speakable(path: &Path) -> bool {
    let last = path.last();
    last.is_some_and(|name| !name.is_empty() && !name.contains('/'))
}

fn key(path: &[String]) -> String {
    format!("/{}", path.join("/"))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::master::Master;

    fn set(master: &mut Master, key: &str, value: Value) {
        let params = vec!["/n".into(), key.into(), value];
        master.apply(&Call::new("setParam", params));
    }

    /// What is found out about `master` by somebody who knew `previous`, and in how many questions.
    fn salvaged(master: &mut Master, previous: &Struct) -> (Struct, Vec<String>, usize) {
        let names = master.apply(&Salvage::names()).reply;
        let mut salvage = Salvage::new(&names, previous).unwrap();
        let mut asked = 0;
        while let Some(call) = salvage.question() {
            asked += 1;
            // As rosmaster: a value that cannot be written is a fault.
            let reply = master.apply(&call).reply;
            salvage.take(Some(&reply));
        }
        let (tree, unknown) = salvage.finish();
        (tree, unknown, asked)
    }

    fn poison() -> Value {
        Value::Array(vec![Value::BigInt("9999999999".into())])
    }

    #[test]
    fn everything_but_the_culprits_is_read() {
        let mut master = Master::default();
        for key in ["/a", "/b/c", "/b/d/e"] {
            set(&mut master, key, key.into());
        }
        // A nil cannot be set alone, only inside a struct.
        let nils = Struct::from([("huge".to_owned(), Value::Nil), ("f".to_owned(), 1.into())]);
        set(&mut master, "/b/d/in", Value::Struct(nils));
        set(&mut master, "/z", 2.into());
        let with_nils = master.params().clone();
        set(&mut master, "/b/d/in/huge", poison());
        let (tree, unknown, asked) = salvaged(&mut master, &Struct::new());
        assert_eq!(Value::Struct(tree), Value::Struct(with_nils));
        assert_eq!(unknown, ["/b/d/in/huge"]);
        // Three at the top, two in each of three namespaces, asked for together and then alone.
        assert_eq!(asked, 4 + 1 + 3 * 3);
    }

    #[test]
    fn a_few_culprits_among_many_are_found_with_a_few_questions() {
        let mut master = Master::default();
        for index in 0..1000 {
            set(&mut master, &format!("/k{index}"), index.into());
        }
        let mut known = master.params().clone();
        for key in ["k3", "k500", "k999"] {
            known.insert(key.to_owned(), Value::Nil);
            set(&mut master, key, poison());
        }
        let (tree, unknown, asked) = salvaged(&mut master, &Struct::new());
        assert_eq!(Value::Struct(tree), Value::Struct(known));
        assert_eq!(unknown, ["/k3", "/k500", "/k999"]);
        assert!(asked < 3 * 2 * 10, "{asked}");
        // Who knows them asks for them apart.
        let previous = master.params().clone();
        let (tree, _, asked) = salvaged(&mut master, &previous);
        assert_eq!(Value::Struct(tree), Value::Struct(previous));
        assert_eq!(asked, 6);
    }

    #[test]
    fn what_cannot_be_read_is_taken_from_what_was_known() {
        let mut master = Master::default();
        set(&mut master, "/old", 1.into());
        set(&mut master, "/ns/empty", Value::Struct(Struct::new()));
        set(&mut master, "/ns/huge", poison());
        set(&mut master, "/ns/gone", 2.into());
        set(&mut master, "/ns/~private", 3.into());
        let odd = Struct::from([("a/b".to_owned(), 4.into()), ("nil".to_owned(), Value::Nil)]);
        set(&mut master, "/odd", Value::Struct(odd));
        let previous = master.params().clone();
        let same = salvaged(&mut master, &previous);
        assert_eq!(Value::Struct(same.0), Value::Struct(previous.clone()));
        assert_eq!(same.1, Vec::<String>::new());

        // Past us.
        set(&mut master, "/old", "new".into());
        set(&mut master, "/ns/more", 5.into());
        let delete = vec!["/n".into(), "/ns/gone".into()];
        master.apply(&Call::new("deleteParam", delete));
        let now = master.params().clone();
        let (tree, unknown, _) = salvaged(&mut master, &previous);
        assert_eq!(Value::Struct(tree), Value::Struct(now));
        assert_eq!(unknown, Vec::<String>::new());
    }

    #[test]
    fn what_is_no_reply_of_a_master_is_refused() {
        let nothing = Struct::new();
        assert!(Salvage::new(&Reply::Value(Value::Int(1)), &nothing).is_none());
        let names = Master::default().apply(&Salvage::names()).reply;
        let mut salvage = Salvage::new(&names, &nothing).unwrap();
        assert_eq!(salvage.question(), None);
        salvage.take(Some(&Reply::Value(Value::Nil)));
        assert_eq!(salvage.finish(), (Struct::new(), Vec::new()));
    }
}
