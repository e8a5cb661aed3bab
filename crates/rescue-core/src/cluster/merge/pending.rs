//! The writes of one partition, without those that later writes of the partition made superfluous.

use std::collections::{BTreeMap, HashMap};

use super::changes::param_of;
use crate::cluster::mutant::Mutant;
use ros1_master::{
    master::{Method, Request, Write, WriteTarget},
    xmlrpc::Value,
};

/// What a call registers or unregisters: for example, the node `caller` as a publisher of the topic `name`.
#[derive(Clone, Debug, PartialEq, Eq, Hash)]
struct RegistrationSlot {
    target: WriteTarget,
    name: String,
    caller: String,
}

/// The last registration of a [`RegistrationSlot`], with its address, and the unregistrations after it.
#[derive(Clone, Debug, Default)]
struct Registered {
    registration: Option<(u64, String)>,
    unregistrations: Vec<(u64, String)>,
}

/// Writes to be sent, in order, without those that later ones made superfluous.
#[derive(Clone, Debug, Default)]
pub struct WritesToSend {
    calls: BTreeMap<u64, Request>,
    last: u64,
    /// The numbers of the writes to parameters, by path and by whether they set the parameter or delete it.
    params: BTreeMap<(String, bool), u64>,
    registered: HashMap<RegistrationSlot, Registered>,
    /// The numbers of other calls, by their encoded form.
    others: HashMap<String, u64>,
}

impl<'a> FromIterator<&'a Request> for WritesToSend {
    fn from_iter<I: IntoIterator<Item = &'a Request>>(calls: I) -> Self {
        let mut writes = Self::default();
        calls.into_iter().for_each(|call| writes.add(call));
        writes
    }
}

impl WritesToSend {
    /// Adds a write that was answered. The entries of a multicall are writes of their own.
    pub fn add(&mut self, call: &Request) {
        for call in call.calls() {
            self.add_one(call);
        }
    }

    fn add_one(&mut self, call: &Request) {
        self.last += 1;
        let number = self.last;
        if let Some(path) = param_of(call) {
            let sets = *call.method() == Method::SetParam;
            let below = self.params.range((path.clone(), false)..);
            let below = below.take_while(|((of, _), _)| of.starts_with(&path));
            let mut below: Vec<_> = below.map(|(of, number)| (*number, of.clone())).collect();
            below.sort();
            if !sets {
                // A deletion needs its parameter and the namespaces that setting it created.
                let last = below.iter().rposition(|(_, (_, sets))| *sets);
                last.map(|last| below.remove(last));
            }
            let below = match Mutant::KeepsEachWrite.lives() {
                true => Vec::new(),
                false => below,
            };
            for (number, of) in below {
                self.params.remove(&of);
                self.calls.remove(&number);
            }
            self.params.insert((path, sets), number);
        } else if let Some((slot, api, registers)) = slot(call) {
            let at = self.registered.entry(slot).or_default();
            if registers {
                let before = std::mem::take(at);
                at.registration = Some((number, api));
                let before = before
                    .registration
                    .into_iter()
                    .chain(before.unregistrations);
                before.for_each(|(number, _)| {
                    self.calls.remove(&number);
                });
            } else {
                if at.registration.as_ref().is_some_and(|(_, of)| *of != api) {
                    // The unregistration belongs to an earlier process of the node, so the master refuses it.
                    return;
                }
                let before = at.unregistrations.iter().position(|(_, of)| *of == api);
                if let Some(before) = before {
                    let (number, _) = at.unregistrations.remove(before);
                    self.calls.remove(&number);
                }
                at.unregistrations.push((number, api));
            }
        } else {
            let encoded = call.encode();
            let encoded = String::from_utf8_lossy(&encoded).into_owned();
            if let Some(before) = self.others.insert(encoded, number) {
                self.calls.remove(&before);
            }
        }
        self.calls.insert(number, call.clone());
    }

    /// The writes in the order in which they were answered.
    pub fn calls(&self) -> impl Iterator<Item = &Request> {
        self.calls.values()
    }

    pub fn len(&self) -> usize {
        self.calls.len()
    }

    pub fn is_empty(&self) -> bool {
        self.calls.is_empty()
    }
}

/// The slot that `call` registers or unregisters, with the address, and whether it registers.
fn slot(call: &Request) -> Option<(RegistrationSlot, String, bool)> {
    let write = Write::parse(call)?;
    let api = write.address()?;
    let slot = RegistrationSlot {
        target: write.target(),
        name: write.name().to_owned(),
        caller: write.caller.to_owned(),
    };
    Some((slot, api.to_owned(), !write.unregisters()))
}

/// The approximate size of a call in bytes.
pub fn weight(call: &Request) -> usize {
    call.params().iter().map(Value::size).sum()
}
