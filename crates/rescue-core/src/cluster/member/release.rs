//! Gives up leadership: for a handover, and when rosrescue stops.

use std::time::{Duration, Instant};

use super::{Action, Member};
use crate::cluster::machine::{self, Role};

/// How long a handover may take.
const HANDOVER_LIMIT: Duration = Duration::from_secs(5);
/// How long giving up leadership may take when rosrescue stops.
const STOP_LIMIT: Duration = Duration::from_secs(4);

/// Why leadership is given up.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub(super) enum Why {
    #[default]
    No,
    /// A handover was requested, and its caller waits.
    Asked,
    /// rosrescue stops, and waits for rosout.
    EndingRosout,
    Stops,
}

/// How leadership is given up: for a handover, or because rosrescue stops.
#[derive(Debug, Default)]
pub(super) struct Release {
    pub(super) why: Why,
    /// The time limit of the handover or the stop.
    pub(super) by: Option<Instant>,
    /// The computer that is to lead next, until the machine knows of the release. Empty for any.
    to: Option<String>,
}

impl Release {
    /// Whether writes wait for the next leader.
    pub(super) fn is_begun(&self) -> bool {
        matches!(self.why, Why::Asked | Why::Stops)
    }
}

impl Member {
    pub(super) fn stop(&mut self, now: Instant) {
        if self.published.has_master {
            self.release.why = Why::EndingRosout;
            self.release.by = Some(now + STOP_LIMIT);
            self.act(Action::EndRosout);
        } else {
            self.end();
        }
    }

    pub(super) fn rosout_ended(&mut self) {
        match self.machine.role() {
            Role::Leading => self.begin_release(Why::Stops, String::new()),
            _ => self.end(),
        }
    }

    pub(super) fn hand_over(&mut self, now: Instant, to: String, refused: Option<String>) {
        let refused = match self.machine.role() {
            Role::Leading if self.release.why != Why::No => {
                Some("a handover or a stop is already under way".to_owned())
            }
            Role::Leading => refused,
            _ => Some("this computer does not lead".to_owned()),
        };
        if let Some(why) = refused {
            return self.act(Action::HandedOver(Err(why)));
        }
        self.begin_release(Why::Asked, to);
        self.release.by = Some(now + HANDOVER_LIMIT);
    }

    /// Gives up leadership. From now on writes wait for the next leader.
    fn begin_release(&mut self, why: Why, to: String) {
        self.release.why = why;
        self.publish_leading();
        self.release.to = Some(to);
    }

    /// Has the machine give up leadership once it knows of all changes. A state that is still being prepared may be all
    /// that a new journal is to have, and the next leader may hold less. A computer that has been cut off meanwhile has
    /// nothing to give up before it leads again.
    pub(super) fn update_release(&mut self) {
        let may = self.outgoing.last() <= self.outgoing.ready();
        if may
            && self.machine.role() == Role::Leading
            && let Some(to) = self.release.to.take()
        {
            self.queue_input(machine::Input::HandOver(to));
        }
    }

    /// Ends a handover: another computer may lead now.
    pub(super) fn released(&mut self) {
        if self.release.why == Why::Asked {
            self.release = Release::default();
            self.act(Action::HandedOver(Ok(())));
        }
    }

    pub(super) fn woken(&mut self, now: Instant) {
        if self.release.by.is_some_and(|by| by <= now) {
            self.release.by = None;
            match self.release.why {
                Why::Asked => {
                    let why = format!("etcd did not answer within {HANDOVER_LIMIT:?}");
                    self.act(Action::HandedOver(Err(why)));
                    // A request that was sent may still reach etcd, so writes keep waiting.
                    if self.release.to.is_some() {
                        self.release = Release::default();
                        self.publish_leading();
                    }
                }
                Why::EndingRosout | Why::Stops => self.end(),
                Why::No => {}
            }
        }
        if self.queue.start_by.is_some_and(|by| by <= now) {
            self.start(now);
        }
        self.queue_input(machine::Input::Wake);
    }

    /// Finishes a stop as soon as this computer no longer leads.
    pub(super) fn end_if_stopped(&mut self) {
        if self.release.why == Why::Stops && self.machine.role() != Role::Leading {
            self.end();
        }
    }

    fn end(&mut self) {
        self.act(Action::End);
    }
}
