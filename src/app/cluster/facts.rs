//! Facts about the other computers, for the status and the log.

use std::{
    collections::BTreeMap,
    time::{Duration, Instant},
};

use rescue_core::cluster::{
    machine::{Role, Settings, View},
    member::MemberEntryChange,
};

use super::ClusterDriver;
use crate::{
    server::others::MemberAddresses,
    status::cluster_facts::{ClusterFacts, LeaderFacts, MemberFacts, Takeover},
};

/// Facts about the other computers.
pub(super) struct ComputerFacts {
    settings: Settings,
    members: BTreeMap<String, MemberFacts>,
    addresses: MemberAddresses,
    leader: Option<LeaderFacts>,
    /// The revision of the leader's key `alive`, and when it was first seen.
    sign: Option<(u64, Instant)>,
    role: (Role, Instant),
    takeovers: u64,
    last_takeover: Option<Takeover>,
    pub(super) lost_writes: u64,
    pub(super) times_cut_off: u64,
}

impl ComputerFacts {
    pub(super) fn new(settings: &Settings, addresses: MemberAddresses) -> Self {
        Self {
            settings: settings.clone(),
            members: BTreeMap::new(),
            addresses,
            leader: None,
            sign: None,
            role: (Role::Joining, Instant::now()),
            takeovers: 0,
            last_takeover: None,
            lost_writes: 0,
            times_cut_off: 0,
        }
    }

    /// Updates the facts from the keys `leader` and `alive`.
    pub(super) fn note_view(&mut self, view: &View) {
        let now = Instant::now();
        if let Some(leader) = &view.leader
            && self.leader.as_ref().is_none_or(|of| of.term != leader.term)
        {
            self.leader = Some(LeaderFacts {
                name: leader.name.clone(),
                uri: leader.uri.clone(),
                version: leader.version.clone(),
                term: leader.term,
                since: now,
            });
            if leader.version != self.settings.version {
                tracing::info!(
                    leader = leader.name,
                    version = leader.version,
                    own = self.settings.version,
                    "the leader runs another version of rosrescue"
                );
            }
        }
        let revision = view.alive.as_ref().map_or(0, |alive| alive.revision);
        if self.sign.is_none_or(|(before, _)| before != revision) {
            self.sign = Some((revision, now));
        }
    }

    /// Updates the facts from what a computer has written about itself. `seq` is the last record of the journal that this
    /// computer knew of until then: a computer writes every 5 s, so what it says is old when the next record comes.
    pub(super) fn note_member_entry(&mut self, change: &MemberEntryChange, seq: u64) {
        let uri = change.entry.as_ref().map(|entry| &*entry.uri);
        self.addresses.set_address(&change.name, uri);
        let Some(entry) = &change.entry else { return };
        let mut roles = Role::ALL.into_iter();
        let role = roles.find(|role| role.as_str() == entry.role);
        let member = MemberFacts {
            name: change.name.clone(),
            uri: entry.uri.clone(),
            version: entry.version.clone(),
            role: role.unwrap_or(Role::Joining),
            behind: seq.saturating_sub(entry.seq),
            last_heard: Instant::now(),
        };
        self.members.insert(change.name.clone(), member);
    }

    /// Checks whether the computer `name` can take over, or any other computer if `name` is empty. Returns the reason
    /// if not.
    pub(super) fn successor(&self, name: &str) -> Result<(), String> {
        let others = self
            .members
            .values()
            .filter(|of| of.name != self.settings.name);
        let there = others.filter(|of| !of.is_away());
        let names: Vec<&str> = there.map(|of| of.name.as_str()).collect();
        if name == self.settings.name {
            return Err(format!("`{name}` already leads"));
        }
        match names.as_slice() {
            [] => Err("no other computer is connected".to_owned()),
            names if name.is_empty() || names.contains(&name) => Ok(()),
            names => Err(format!(
                "`{name}` is not connected; connected are {}",
                names.join(", ")
            )),
        }
    }

    /// Notes that this computer leads now. `released` says whether the previous leader gave up leadership by itself.
    pub(super) fn taken_over(&mut self, before: Option<(String, Instant)>, released: bool) {
        let now = Instant::now();
        let took = before
            .as_ref()
            .map_or(Duration::ZERO, |(_, sign)| now.duration_since(*sign));
        let from = before
            .map(|(name, _)| name)
            .filter(|name| *name != self.settings.name);
        self.takeovers += u64::from(from.is_some());
        let takeover = Takeover {
            at: now,
            took,
            from,
            in_order: released,
        };
        match &takeover.from {
            Some(from) => tracing::warn!(
                from,
                in_order = released,
                took = ?took,
                "this computer leads now: its mirror answers, and it starts a master"
            ),
            None => tracing::info!("this computer leads now"),
        }
        self.last_takeover = Some(takeover);
    }
}

impl ClusterDriver {
    /// Since when no computer leads, as far as is known.
    fn leaderless(&self) -> Option<Instant> {
        let (role, since) = self.facts.role;
        let gone = match role {
            Role::Leading => false,
            Role::Following => self.member.was_released() || self.member.view().leader.is_none(),
            Role::Joining | Role::CatchingUp | Role::Alone => true,
        };
        let sign = self.facts.sign.map_or(since, |(_, at)| at);
        gone.then_some(sign)
    }

    /// The last record of the journal that this computer knows of.
    pub(super) fn last_seq(&self) -> u64 {
        self.member.view().seq().max(self.member.seq())
    }

    /// Updates the status.
    pub(super) fn show(&mut self) {
        self.facts.note_view(self.member.view());
        if self.facts.role.0 != self.member.role() {
            self.facts.role = (self.member.role(), Instant::now());
        }
        let facts = &self.facts;
        let last = self.last_seq();
        let behind = last - self.member.seq();
        let own = self.member.member_entry();
        let own = MemberFacts {
            name: self.member.settings().name.clone(),
            uri: own.uri,
            version: own.version,
            role: self.member.machine().role(),
            behind,
            last_heard: Instant::now(),
        };
        let others = facts.members.values().filter(|of| of.name != own.name);
        let mut members: Vec<_> = others.cloned().collect();
        members.push(own);
        members.sort_by(|a, b| a.name.cmp(&b.name));
        let facts = ClusterFacts {
            name: self.member.settings().name.clone(),
            role: facts.role.0,
            since: facts.role.1,
            leader: facts.leader.clone(),
            leaderless: self.leaderless(),
            seq: last,
            behind,
            uncommitted: self.member.uncommitted() as u64,
            etcd: self.trouble.get().or_else(|| {
                let lost = self.member.etcd_lost()?;
                Some((
                    lost,
                    "it has lost its data; a computer is restoring it".to_owned(),
                ))
            }),
            members,
            takeovers: facts.takeovers,
            last_takeover: facts.last_takeover.clone(),
            lost_writes: facts.lost_writes,
            times_cut_off: facts.times_cut_off,
        };
        let board = &self.setup.context.board;
        board.update(|board| board.cluster = Some(facts));
    }
}
