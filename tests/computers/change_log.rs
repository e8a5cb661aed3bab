use crate::computer::PORT;
use crate::fleet::Fleet;
use crate::support::{Client, encode_call, eventually, params, request};
use crate::turn;

/// The address from which `key` was set, according to the log of each computer.
fn origins(fleet: &Fleet, key: &str) -> Vec<String> {
    let origin = |computer: &crate::computer::Computer| {
        let checkpoint = computer.path("chkpt.yaml");
        let checkpoint = checkpoint.to_str().unwrap();
        let arguments = ["log", "--json", "--param", key, "--checkpoint", checkpoint];
        let (_, text) = computer.rosrescue(&arguments);
        let entry: serde_json::Value = serde_json::from_str(&text).unwrap_or_default();
        entry["from"].as_str().unwrap_or_default().to_owned()
    };
    fleet.computers.iter().map(origin).collect()
}

#[test]
fn the_log_of_every_computer_has_the_callers_address() {
    let _turn = turn();
    let fleet = Fleet::quick(&[]);
    let leader = fleet.await_whole();
    let rest = fleet.others(leader);
    let [follower, caller] = [&fleet.computers[rest[0]], &fleet.computers[rest[1]]];
    caller.within(|| Client::at(&follower.address(), PORT).set_param("/far", 1));
    follower.set_param("/near", 1);
    for (key, from) in [("/far", caller.address()), ("/near", follower.address())] {
        let wanted = vec![from; 3];
        eventually(&format!("the log of all has {key}"), || {
            origins(&fleet, key) == wanted
        });
    }

    // Any program that reaches the leader may claim to forward a call, but only a member may name the caller.
    let (leader, named) = (&fleet.computers[leader], caller);
    let term = leader.status().unwrap()["cluster"]["leader"]["term"].clone();
    let forward = |client: Client, key: &str| {
        let path = format!("POST /cluster/{term} HTTP/1.1");
        let header = format!("x-rosrescue-caller: {}", named.address());
        let call = encode_call("setParam", params!["/n", key, 1]);
        let answer = client.exchange(&request(&path, &[&header], &call)).unwrap();
        assert!(answer.status.contains("200"), "{}", answer.text());
    };
    // 127.0.0.1 is no member's address.
    leader.within(|| forward(leader.client(), "/stranger"));
    follower.within(|| forward(Client::at(&leader.address(), PORT), "/member"));
    for (key, from) in [
        ("/stranger", leader.address()),
        ("/member", named.address()),
    ] {
        let wanted = vec![from; 3];
        eventually(&format!("the log of all has {key}"), || {
            origins(&fleet, key) == wanted
        });
    }
}
