//! What to do about a finding, mostly as a command.

use super::super::facts::{Host, SetupFacts};
use crate::ros_env;

/// The `ROS_MASTER_URI` of nodes that use a master of this computer.
pub(super) fn own_uri(facts: &SetupFacts) -> String {
    let own = &facts.own;
    let port = facts
        .port
        .as_ref()
        .map_or(ros_env::DEFAULT_MASTER_PORT, |port| port.number);
    let host = match own.is_here && own.addresses.is_ok() {
        true => own.name.clone(),
        false => "localhost".to_owned(),
    };
    ros_env::MasterUri { host, port }.to_string()
}

/// How to register this computer's nodes at an address that others reach.
pub(super) fn set_address(facts: &SetupFacts) -> String {
    if let Some(address) = facts.local.filter(|address| address.is_ipv6()) {
        // roscpp does not understand an IPv6 address in a URI.
        return format!(
            "`export ROS_HOSTNAME=NAME` before anything starts, with a name that every computer resolves to {address}"
        );
    }
    let unset = match facts.env.hostname {
        Some(_) => "unset ROS_HOSTNAME; ",
        None => "",
    };
    let address = address_of_this(facts);
    format!("`{unset}export ROS_IP={address}` before anything starts")
}

/// The command that makes this computer resolve `name` to `address`.
pub(super) fn host_entry(address: &str, name: &str) -> String {
    format!("`echo {address} {name} | sudo tee -a /etc/hosts`")
}

/// This computer's address, or a command that prints it.
pub(super) fn address_of_this(facts: &SetupFacts) -> String {
    let local = facts.local.map(|address| address.to_string());
    local.unwrap_or_else(|| "$(hostname -I | cut -d' ' -f1)".to_owned())
}

/// The first address of `host`, or a placeholder.
pub(super) fn first_address(host: Option<&Host>) -> String {
    let first = host.and_then(|host| host.addresses.as_ref().ok()?.first());
    first.map_or_else(|| "ADDRESS".to_owned(), ToString::to_string)
}

/// How to free space on the disk of ROS's logs. `rosclean purge` would delete the checkpoint, too.
pub(super) fn delete_logs() -> String {
    "`find ~/.ros/log -name '*.log*' -not -name 'latest-chkpt*' -mtime +2 -delete` deletes old logs"
        .to_owned()
}
