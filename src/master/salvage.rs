//! Reading the parameters of a master that cannot return them all at once.

use super::{CALLER_ID, Master};
use crate::xmlrpc::{Call, Reply, Struct, Value};

/// The parameters of a master that holds one which it cannot return, read part by part.
///
/// Such a parameter spoils every namespace around it, so a namespace that cannot be read is entered,
/// and what else is in it is read alone. An empty namespace beside the culprit stays unknown:
/// `getParamNames` does not name it.
#[derive(Clone, Debug, Default)]
pub struct Salvage {
    /// Keys of all leaves, without the leading slash.
    leaves: Vec<String>,
    /// Keys still to be asked for, the next one last.
    open: Vec<String>,
    /// What has been read.
    found: Master,
    unreadable: Vec<String>,
}

impl Salvage {
    /// The question for the names of all parameters. They can always be returned.
    pub fn names() -> Call {
        Call::new("getParamNames", vec![CALLER_ID.into()])
    }

    /// Begins with the reply to [`Salvage::names`]; none if it is not that of a master.
    pub fn new(names: &Reply) -> Option<Self> {
        let Reply::Value(Value::Array(fields)) = names else {
            return None;
        };
        let names = fields.get(2)?.as_array()?;
        let leaf = |name: &Value| Some(name.as_str()?.trim_start_matches('/').to_owned());
        let mut salvage = Self {
            leaves: names.iter().map(leaf).collect::<Option<_>>()?,
            ..Self::default()
        };
        salvage.enter("");
        Some(salvage)
    }

    /// What to ask next.
    pub fn next(&self) -> Option<Call> {
        let key = format!("/{}", self.open.last()?);
        Some(Call::new("getParam", vec![CALLER_ID.into(), key.into()]))
    }

    /// Takes in the reply to [`Salvage::next`], none if it was no XML-RPC. A key that vanished
    /// meanwhile is left out.
    pub fn take(&mut self, reply: Option<&Reply>) {
        let Some(key) = self.open.pop() else { return };
        match reply {
            Some(Reply::Value(Value::Array(fields))) => {
                if let [Value::Int(1), _, value] = fields.as_slice() {
                    let key = format!("/{key}").into();
                    let params = vec![CALLER_ID.into(), key, value.clone()];
                    self.found.apply(&Call::new("setParam", params));
                }
            }
            _ if self.leaves.contains(&key) => {
                self.unreadable.push(format!("/{key}"));
            }
            _ => self.enter(&format!("{key}/")),
        }
    }

    /// What could be read, and the keys of what could not.
    pub fn finish(self) -> (Struct, Vec<String>) {
        (self.found.params().clone(), self.unreadable)
    }

    /// Asks for each thing directly in the namespace `prefix`, in order.
    fn enter(&mut self, prefix: &str) {
        let mut inside: Vec<String> = Vec::new();
        for leaf in &self.leaves {
            if let Some(rest) = leaf.strip_prefix(prefix)
                && let Some(name) = rest.split('/').next().filter(|name| !name.is_empty())
            {
                let key = format!("{prefix}{name}");
                if !inside.contains(&key) {
                    inside.push(key);
                }
            }
        }
        self.open.extend(inside.into_iter().rev());
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn set(master: &mut Master, key: &str, value: Value) {
        let params = vec!["/n".into(), key.into(), value];
        master.apply(&Call::new("setParam", params));
    }

    #[test]
    fn everything_but_the_culprits_is_read() {
        let mut master = Master::default();
        for key in ["/a", "/b/c", "/b/d/e", "/b/d/f", "/z"] {
            set(&mut master, key, key.into());
        }
        let whole = master.params().clone();
        for key in ["/b/d/huge", "/nil"] {
            set(
                &mut master,
                key,
                Value::Array(vec![Value::BigInt("9999999999".into())]),
            );
        }
        let ask = |master: &mut Master, call: &Call| master.apply(call).reply;
        let names = ask(&mut master, &Salvage::names());
        let mut salvage = Salvage::new(&names).unwrap();
        let mut asked = 0;
        while let Some(call) = salvage.next() {
            asked += 1;
            // As rosmaster: a value that cannot be written is a fault.
            let reply = ask(&mut master, &call);
            salvage.take(Some(&reply));
        }
        let (tree, unreadable) = salvage.finish();
        assert_eq!(tree, whole);
        assert_eq!(unreadable, ["/b/d/huge", "/nil"]);
        assert_eq!(asked, 4 + 2 + 3, "each namespace at most once");
    }

    #[test]
    fn what_is_no_reply_of_a_master_is_refused() {
        assert!(Salvage::new(&Reply::Value(Value::Int(1))).is_none());
        let mut salvage = Salvage::default();
        assert_eq!(salvage.next(), None);
        salvage.take(Some(&Reply::Value(Value::Nil)));
    }
}
