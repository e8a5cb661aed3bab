//! Calls of our own that what others did has overtaken.

use crate::{
    master::Master,
    proxy::{Proxy, activity::Activity, journey::LaneItem},
    xmlrpc::Call,
};

/// Whether a call of our own was right when it was sent off and is no longer: the node has come back at
/// another address, and would be shut down for it, or has done the contrary itself.
pub(super) fn is_overtaken(proxy: &Proxy, item: &LaneItem) -> bool {
    let premise = item.premise.as_ref();
    let is_false = premise.is_some_and(|of| {
        let deeds = |_: &Master, activity: &mut Activity| activity.deeds(&of.node);
        !of.holds(item.kind, proxy.shadow.with_activity(deeds))
    });
    let own = item.call.as_ref().filter(|_| item.raw.is_none());
    is_false || own.is_some_and(|call| bumps(proxy, call))
}

/// Whether the master would shut a node down because of `call`, or of an entry of it.
fn bumps(proxy: &Proxy, call: &Call) -> bool {
    let entries = call.entries();
    proxy.shadow.with_mirror(|mirror| {
        let mut calls = entries.iter().chain([call]);
        calls.any(|call| mirror.displaced_by(call).is_some())
    })
}
