//! Giving up leading: as asked, and when rosrescue stops.

use std::time::{Duration, Instant};

use super::{Duty, Member};
use crate::{
    app::RunError,
    cluster::{
        machine::{Input, Role},
        way::Way,
    },
    server::others::Handover,
};

/// How long a leader may take to give up leading.
const HANDOVER_LIMIT: Duration = Duration::from_secs(5);
/// The same when it stops.
const STOP_LIMIT: Duration = Duration::from_secs(4);

impl Member {
    pub(super) fn begin_stop(&mut self) -> Option<Option<RunError>> {
        if self.duty.is_none() {
            return Some(None);
        }
        self.release_by = Some(Instant::now() + STOP_LIMIT);
        let ended = self.duty.as_mut().map(Duty::end_roscore);
        self.ending_roscore = Some(Box::pin(async move {
            if let Some(ended) = ended {
                ended.await;
            }
        }));
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

    /// Calls that write wait from now on for whoever leads next.
    pub(super) fn begin_release(&mut self, to: String) {
        self.set_way(Way::Nobody { known: true });
        self.inbox.push_back(Input::HandOver(to));
    }

    /// Whether nobody waits for this computer to give up leading.
    pub(super) fn duty_is_free(&self) -> bool {
        self.machine.role() != Role::Leading && self.inbox.is_empty()
    }
}
