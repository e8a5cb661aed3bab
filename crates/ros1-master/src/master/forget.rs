//! Removes a node from a master completely.

use super::{Master, Method, Request, names};

/// The address under which a service is registered only to unregister it again.
const GONE_SERVICE: &str = "rosrpc://127.0.0.1:1";

impl Master {
    /// The calls that make a master drop a node completely.
    ///
    /// If another node has taken over a service of this node, rosmaster keeps a reference to the node. To remove it,
    /// the node takes the service back and unregisters it. Then the other node's service is registered again.
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
            // This is only possible if the service can be given back to the other node.
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
