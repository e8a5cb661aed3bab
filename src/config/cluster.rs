//! The options of several computers.

use std::{path::PathBuf, time::Duration};

use crate::ros_env::MasterUri;

/// How this computer takes part in a cluster of several.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct ClusterConfig {
    /// The members of etcd, `http://HOST:PORT` or `https://HOST:PORT` each.
    pub endpoints: Vec<String>,
    /// The robot's name: all its keys in etcd begin with it.
    pub robot: String,
    /// This computer's name. No other one of the robot has it.
    pub name: String,
    /// Where the other computers reach this rosrescue.
    pub advertised: MasterUri,
    /// How long the leader may be silent.
    pub ttl: Duration,
    /// When a write is acknowledged.
    pub sync: ClusterSync,
    /// What happens to writes while this computer is cut off.
    pub alone: WhenCutOff,
    /// Certificates in PEM form: etcd's authority, and this computer's own with its key.
    pub ca: Option<PathBuf>,
    pub cert: Option<PathBuf>,
    pub key: Option<PathBuf>,
    /// Name and password of etcd's user.
    pub user: Option<(String, String)>,
}

/// When a write is acknowledged.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum ClusterSync {
    /// When a majority of etcd has it.
    Always,
    /// At once; a majority has it 200 ms later.
    Interval,
}

/// What a computer does with writes while it is cut off from the others.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum WhenCutOff {
    /// It answers them, and sends them to the leader when it can.
    Serve,
    /// It lets them wait.
    Refuse,
}
