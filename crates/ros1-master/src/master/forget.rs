//! Taking a node out of a master altogether.

use super::{Master, Method, Request, names};

/// The address of a service for as long as it takes to give it up.
const GONE_SERVICE: &str = "rosrpc://127.0.0.1:1";

impl Master {
    /// The calls after which a master knows nothing of a node any more.
    ///
    /// To a reference by a service that another node took over, the node takes the service back, gives it up,
    /// and the other one registers it anew.
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
            // Not if it could not be given back.
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
