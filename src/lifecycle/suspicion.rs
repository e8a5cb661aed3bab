//! Whether masters die of one record of the state, and of which.
//!
//! A master that dies twice in a row while the state is being injected is given it *carefully* from
//! then on: entry by entry, so that it is known which one was in flight when it died. That one is
//! only *suspected*: a master that dies at its tenth call dies at something, too. In the next life
//! the suspect is put to the test. It comes at its natural place, but after a series of calls of its
//! own method that do nothing, and after a pause. Whoever counts calls dies in the series, and
//! whoever counts seconds dies in the pause; only a master that dies of this very record dies at it
//! again. Then it is *convicted* and left out of the next life; and only when that life has taken
//! everything else is it set aside. So a record that kills costs four masters, and nothing is set
//! aside without the proof that the rest is harmless.
//!
//! Whatever speaks against a suspect clears all: a death in between, or at an entry that has been
//! survived before. So do records of more than [`CONVICTED_MOST`] topics, services and parameters,
//! since then it is not the records.

use std::time::Duration;

use crate::xmlrpc::Call;

/// So many masters in a row must have died in an injection before it is done carefully.
const DEATHS_BEFORE_CARE: u32 = 2;
/// Records of so many topics, services and parameters are left out at a time, at most.
pub(super) const CONVICTED_MOST: usize = 5;
/// How long the pause of a test is at least.
const PAUSE_LEAST: Duration = Duration::from_millis(250);
/// How long it is at most.
const PAUSE_MOST: Duration = Duration::from_secs(10);

/// What a master was at when it died.
#[derive(Clone, Debug, Default, PartialEq)]
pub enum InFlight {
    /// Not at an injection.
    #[default]
    Nothing,
    /// At an injection as a whole.
    Whole,
    /// At a careful injection, but at none of its records.
    NoRecord,
    /// At one record of a careful injection.
    Record {
        /// The entry.
        call: Call,
        /// How many records this life had taken before.
        index: usize,
        /// How long this life had been known.
        age: Duration,
    },
}

/// A record under suspicion.
#[derive(Clone, Debug, PartialEq)]
struct Suspect {
    call: Call,
    index: usize,
    age: Duration,
}

/// How a careful injection is to go.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Trial {
    /// What is left out.
    pub left_out: Vec<Call>,
    /// What is put to the test, and how old the master must be before.
    pub tested: Option<(Call, Duration)>,
}

/// What is known of the latest deaths.
#[derive(Debug, Default)]
pub struct Suspicion {
    /// Deaths in injections since the last that was survived.
    deaths: u32,
    suspect: Option<Suspect>,
    convicted: Vec<Suspect>,
}

impl Suspicion {
    /// How the next injection is to go; none for all at once.
    pub fn trial(&self) -> Option<Trial> {
        (self.deaths >= DEATHS_BEFORE_CARE).then(|| Trial {
            left_out: self.convicted.iter().map(|of| of.call.clone()).collect(),
            tested: self.suspect.as_ref().map(|suspect| {
                let age = (suspect.age * 2 + PAUSE_LEAST).min(PAUSE_MOST);
                (suspect.call.clone(), age)
            }),
        })
    }

    /// A master has died.
    pub fn died(&mut self, at: InFlight) {
        let (call, index, age) = match at {
            InFlight::Nothing => return,
            InFlight::Whole => {
                self.deaths = self.deaths.saturating_add(1);
                return;
            }
            InFlight::NoRecord => return self.clear(),
            InFlight::Record { call, index, age } => (call, index, age),
        };
        let suspect = Suspect { call, index, age };
        let before = self.suspect.take();
        if before.as_ref().is_some_and(|of| of.call == suspect.call) {
            self.convicted.push(suspect);
            let mut subjects: Vec<_> = self.convicted.iter().map(|of| subject(&of.call)).collect();
            subjects.sort_unstable();
            subjects.dedup();
            if subjects.len() > CONVICTED_MOST {
                self.clear();
            }
            return;
        }
        // Lives that ended at a later record have survived this one.
        if (before.iter().chain(&self.convicted)).any(|of| of.index > index) {
            self.clear();
        }
        self.suspect = Some(suspect);
    }

    /// A master has been brought to the state, but for what was left out.
    pub fn survived(&mut self) {
        *self = Self::default();
    }

    fn clear(&mut self) {
        self.suspect = None;
        self.convicted.clear();
    }
}

/// The topic, service or parameter that a call is about.
fn subject(call: &Call) -> Option<&str> {
    let index = if call.method == "subscribeParam" {
        2
    } else {
        1
    };
    call.params.get(index)?.as_str()
}

#[cfg(test)]
mod tests;
