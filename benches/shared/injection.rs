//! Gives a state to an empty rosmaster in as few bytes and calls as possible.

use ros1_master::xmlrpc::{self, Call};

use super::support::{State, params};

/// Encodes one multicall that gives `state` to an empty master, in an order in which no node is notified.
pub(crate) fn injection(state: &State) -> Vec<u8> {
    let text = |pairs: &[(String, String)], key: &str| {
        let found = pairs.iter().find(|(name, _)| name == key);
        found
            .map(|(_, value)| value.clone())
            .expect("a name that is known")
    };
    let register = |method: &'static str, table: &[(String, Vec<String>)]| {
        let mut calls = Vec::new();
        for (topic, nodes) in table {
            for node in nodes {
                let topic_type = text(&state.topic_types, topic);
                let api = text(&state.nodes, node);
                calls.push(Call::new(
                    method,
                    params![node.clone(), topic.clone(), topic_type, api],
                ));
            }
        }
        calls
    };
    let services = state.services.iter().map(|(service, nodes)| {
        let service_api = text(&state.service_apis, service);
        let api = text(&state.nodes, &nodes[0]);
        let params = params![nodes[0].clone(), service.clone(), service_api, api];
        Call::new("registerService", params)
    });
    let params = Call::new("setParam", params!["/limit", "/", state.params.clone()]);
    let publishers = register("registerPublisher", &state.publishers);
    let subscribers = register("registerSubscriber", &state.subscribers);
    let calls = [params]
        .into_iter()
        .chain(publishers)
        .chain(services)
        .chain(subscribers);
    xmlrpc::encode_call(&Call::multicall(calls))
}
