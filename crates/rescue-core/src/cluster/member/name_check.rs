//! Ends a computer whose name another living computer has.

use std::time::Instant;

use super::{Action, Member, News};
use crate::cluster::{
    machine::View,
    mutant::Mutant,
    namesake::{self, Sign},
};

/// Evidence of another computer with this one's name.
#[derive(Debug, Default)]
pub(super) struct Namesake {
    /// Set if the member entry of this name belongs to another computer.
    pub(super) sign: Option<Sign>,
    /// Looks for a living computer with this one's name. Set once etcd has been read.
    pub(super) watch: Option<namesake::NamesakeWatch>,
    /// The last term in which this process has led, or 0.
    pub(super) led_in: u64,
}

impl Member {
    /// Delays the start if another computer may have this one's name.
    pub(super) fn begin_watch_for_namesake(&mut self, now: Instant, view: &View) {
        let signs = self.signs_of_namesake(view);
        let watch = namesake::NamesakeWatch::new(now, self.settings().ttl, signs);
        if let (Some(until), Some(uri)) = (watch.hold(), watch.suspect()) {
            let uri = uri.to_owned();
            self.queue.start_by = self.queue.start_by.map(|_| until);
            self.report_news(News::Suspect { uri, until });
        }
        self.namesake.watch = Some(watch);
    }

    /// Ends this member if another living computer has its name.
    pub(super) fn check_for_namesake(&mut self, now: Instant) {
        let view = self.view();
        let signs = self.signs_of_namesake(view);
        let watch = self.namesake.watch.as_ref();
        let living = watch.and_then(|watch| watch.living(now, &signs));
        let mut there = living.map(|sign| sign.uri.clone());
        if let Some(leader) = &view.leader {
            let own = self.machine.settings();
            // After a loss of etcd's data, this process leads under another id, with one more `+`.
            let process = |id: &str| id.trim_end_matches('+').to_owned();
            let is_this = process(&leader.id) == process(&own.id);
            // Only one process runs on a computer at a time, so any other leader is another computer.
            if is_this {
                self.namesake.led_in = self.namesake.led_in.max(leader.term);
            } else if self.namesake.led_in > 0
                // An older copy of etcd may show an earlier process of this computer.
                && leader.term > self.namesake.led_in
                && leader.name == own.name
                && !self.data_loss.is_remainder(view)
            {
                there = there.or_else(|| Some(leader.uri.clone()));
            }
        }
        if let Some(uri) = there.filter(|_| !Mutant::IgnoresNamesake.lives()) {
            self.act(Action::EndForNamesake(uri));
        }
    }

    /// The evidence in etcd of another computer with this one's name.
    fn signs_of_namesake(&self, view: &View) -> Vec<Sign> {
        let leader = namesake::sign_of_leader(self.settings(), view);
        let member = self.namesake.sign.clone();
        leader.into_iter().chain(member).collect()
    }
}
