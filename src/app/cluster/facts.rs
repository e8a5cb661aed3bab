//! What is known of the other computers, for people.

use std::{
    collections::BTreeMap,
    time::{Duration, Instant},
};

use serde::{Deserialize, Serialize};

use super::{Member, Role, Settings, View};
use crate::{
    cluster::{
        etcd::Kv,
        journal::Keys,
        namesake::{Key, Sign},
    },
    status::cluster::{ClusterFacts, LeaderFacts, MemberFacts, Takeover},
};

/// What a computer says of itself, in JSON at `ROBOT/members/NAME`.
#[derive(Serialize, Deserialize)]
struct Said {
    uri: String,
    version: String,
    role: String,
    seq: u64,
    /// See [`Settings::boot`].
    #[serde(default)]
    boot: String,
}

/// What is known of the other computers.
pub(super) struct Known {
    settings: Settings,
    members: BTreeMap<String, MemberFacts>,
    /// The entry under this computer's name, if another computer wrote it.
    namesake: Option<Sign>,
    leader: Option<LeaderFacts>,
    /// The revision of the last sign of a leader, and when it was seen.
    sign: Option<(u64, Instant)>,
    role: (Role, Instant),
    takeovers: u64,
    last_takeover: Option<Takeover>,
    pub(super) lost_writes: u64,
}

impl Known {
    pub(super) fn new(settings: &Settings) -> Self {
        Self {
            settings: settings.clone(),
            members: BTreeMap::new(),
            namesake: None,
            leader: None,
            sign: None,
            role: (Role::Joining, Instant::now()),
            takeovers: 0,
            last_takeover: None,
            lost_writes: 0,
        }
    }

    /// Looks at the keys.
    pub(super) fn look(&mut self, view: &View) {
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
                    "the leader has another version of rosrescue"
                );
            }
        }
        let revision = view.alive.as_ref().map_or(0, |alive| alive.revision);
        if self.sign.is_none_or(|(before, _)| before != revision) {
            self.sign = Some((revision, now));
        }
    }

    pub(super) fn namesake(&self) -> Option<&Sign> {
        self.namesake.as_ref()
    }

    /// A key has changed; `kv` is none if it was deleted.
    pub(super) fn member(&mut self, keys: &Keys, key: &str, kv: Option<&Kv>) {
        let Some(name) = key.strip_prefix(&keys.member("")) else {
            return;
        };
        let said = kv.and_then(|kv| serde_json::from_slice::<Said>(&kv.value).ok());
        if name == self.settings.name {
            let own = &self.settings;
            let other = said.as_ref();
            let other = other.filter(|of| !own.is_of_this_computer(name, &of.uri, &of.boot));
            self.namesake = other.zip(kv).map(|(of, kv)| Sign {
                key: Key::Member,
                uri: of.uri.clone(),
                revision: kv.revision,
            });
        }
        if let Some(said) = said {
            let role = Role::ALL
                .into_iter()
                .find(|role| role.as_str() == said.role);
            let member = MemberFacts {
                name: name.to_owned(),
                uri: said.uri,
                version: said.version,
                role: role.unwrap_or(Role::Joining),
                seq: said.seq,
                heard: Some(Instant::now()),
            };
            self.members.insert(name.to_owned(), member);
        }
    }

    /// What this computer says of itself.
    pub(super) fn own(&self, role: Role, seq: u64) -> Vec<u8> {
        let said = Said {
            uri: self.settings.uri.clone(),
            version: self.settings.version.clone(),
            role: role.as_str().to_owned(),
            seq,
            boot: self.settings.boot.clone(),
        };
        serde_json::to_vec(&said).unwrap_or_default()
    }

    /// Whether `name`, or any other computer if it is empty, can take over; if not, why.
    pub(super) fn successor(&self, name: &str) -> Result<(), String> {
        let others = self
            .members
            .values()
            .filter(|of| of.name != self.settings.name);
        let there = others.filter(|of| {
            of.heard
                .is_some_and(|at| at.elapsed() < MemberFacts::AWAY_AFTER)
        });
        let names: Vec<&str> = there.map(|of| of.name.as_str()).collect();
        if name == self.settings.name {
            return Err(format!("`{name}` leads already"));
        }
        match names.as_slice() {
            [] => Err("no other computer is there".to_owned()),
            names if name.is_empty() || names.contains(&name) => Ok(()),
            names => Err(format!(
                "`{name}` is not there; there are {}",
                names.join(", ")
            )),
        }
    }

    /// This computer leads now. `released`: the one before has given up leading by itself. Returns whether that
    /// was another computer.
    pub(super) fn taken_over(&mut self, before: Option<(String, Instant)>, released: bool) -> bool {
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
        let from_another = takeover.from.is_some();
        self.last_takeover = Some(takeover);
        from_another
    }

    /// Who led last, and when it was heard of last.
    pub(super) fn before(&self) -> Option<(String, Instant)> {
        let leader = self.leader.as_ref()?;
        Some((leader.name.clone(), self.sign?.1))
    }

    pub(super) fn role(&self) -> Role {
        self.role.0
    }

    /// Returns the role before.
    pub(super) fn set_role(&mut self, role: Role) -> Role {
        std::mem::replace(&mut self.role, (role, Instant::now())).0
    }
}

impl Member {
    /// Since when nobody leads, as far as is known.
    fn leaderless(&self) -> Option<Instant> {
        let (role, since) = self.known.role;
        let gone = match role {
            Role::Leading => false,
            Role::Following => self.was_released || self.view.leader.is_none(),
            Role::Joining | Role::CatchingUp | Role::Alone => true,
        };
        let sign = self.known.sign.map_or(since, |(_, at)| at);
        gone.then_some(sign)
    }

    /// Shows on the board how it is.
    pub(super) fn show(&mut self) {
        let known = &self.known;
        let own = MemberFacts {
            name: self.settings.name.clone(),
            uri: self.settings.uri.clone(),
            version: self.settings.version.clone(),
            role: self.machine.role(),
            seq: self.progress.seq,
            heard: Some(Instant::now()),
        };
        let others = known.members.values().filter(|of| of.name != own.name);
        let mut members: Vec<_> = others.cloned().collect();
        members.push(own);
        members.sort_by(|a, b| a.name.cmp(&b.name));
        let seq = self.view.seq().max(self.progress.seq);
        let facts = ClusterFacts {
            name: self.settings.name.clone(),
            role: known.role.0,
            since: known.role.1,
            leader: known.leader.clone(),
            leaderless: self.leaderless(),
            seq,
            behind: seq - self.progress.seq,
            uncommitted: self.uncommitted() as u64,
            etcd: self.trouble.get(),
            members,
            takeovers: known.takeovers,
            last_takeover: known.last_takeover.clone(),
            lost_writes: known.lost_writes,
        };
        self.given
            .context
            .board
            .update(|board| board.cluster = Some(facts));
    }
}
