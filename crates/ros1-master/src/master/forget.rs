//! Removes a node from a master completely.

use super::{Master, Method, Request, names};

/// The address under which a node takes a service back, only to unregister it at once.
const GONE_SERVICE: &str = "rosrpc://127.0.0.1:1";

impl Master {
    /// The calls that make a master drop a node completely.
    ///
    /// If another node has taken over a service of this node, rosmaster keeps a reference to this node. To remove the
    /// reference, the calls let this node take the service back and unregister it. Then they register the other node as
    /// the provider again.
    pub fn forget_calls(&self, caller_id: &str) -> Vec<Request> {
        let mut calls = self.unregister_calls(caller_id);
        let Some(node) = self.registry.nodes.get(caller_id) else {
            return calls;
        };
        for service in self.taken_over(caller_id, node) {
            let provider = self.registry.services.get(service);
            let again = provider.map(|entry| {
                let name = names::name_for(service, &entry.node)?;
                let params = [&entry.node, &name, &entry.api, self.api_of(&entry.node)?];
                Some(Request::new(Method::RegisterService, params))
            });
            // Takes the service back only if it can be registered for the other node again afterwards.
            if let Some(name) = names::name_for(service, caller_id)
                && again != Some(None)
            {
                let of = |method, more: &[&str]| {
                    Request::new(method, [&[caller_id, &name, GONE_SERVICE], more].concat())
                };
                calls.push(of(Method::RegisterService, &[&node.api]));
                calls.push(of(Method::UnregisterService, &[]));
                calls.extend(again.flatten());
            }
        }
        calls
    }
}
