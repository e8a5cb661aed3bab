//! Giving up leading: as asked, and when rosrescue stops.

use std::time::{Duration, Instant};

use super::Member;
use crate::{
    app::RunError,
    cluster::{
        machine::{Input, Role},
        way::Way,
    },
    server::others::Handover,
};

/// How long a leader may take to give up leading.
pub(super) const HANDOVER_LIMIT: Duration = Duration::from_secs(5);
/// The same when it stops.
const STOP_LIMIT: Duration = Duration::from_secs(4);

impl Member {
    pub(super) fn begin_stop(&mut self) -> Option<Option<RunError>> {
        let Some(duty) = &mut self.duty else {
            return Some(None);
        };
        self.ending_roscore = Some(Box::pin(duty.end_roscore()));
        self.release_by = Some(Instant::now() + STOP_LIMIT);
        None
    }

    pub(super) fn hand_over(&mut self, handover: Handover) {
        let (to, tell) = handover;
        let refused = match self.machine.role() {
            Role::Leading if self.released.is_some() => Some("it is being done already".to_owned()),
            Role::Leading => self.known.successor(&to).err(),
            _ => Some("this computer does not lead".to_owned()),
        };
        if let Some(why) = refused {
            let _ = tell.send(Err(why));
            return;
        }
        tracing::info!(to, "giving up leading, as asked");
        self.begin_release(to.clone());
        self.release_by = Some(Instant::now() + HANDOVER_LIMIT);
        self.released = Some((to, tell));
    }

    /// Calls that write wait from now on for the next leader.
    pub(super) fn begin_release(&mut self, to: String) {
        self.set_way(Way::Nobody { known: true });
        self.inbox.push_back(Input::HandOver(to));
    }

    /// Whether a stop has nothing more to wait for: rosout has ended, and another computer may lead.
    pub(super) fn may_stop(&self) -> bool {
        self.ending_roscore.is_none()
            && self.machine.role() != Role::Leading
            && self.inbox.is_empty()
    }
}
