//! Nodes that talk directly to the master of `proxy`, bypassing rosrescue.

use crate::support::{
    Library, Node, Rosmaster, Scratch, Setup, Tool, eventually, names, page, signal, status,
};

#[test]
fn a_node_that_bypasses_rosrescue_is_named_until_it_ends() {
    let scratch = Scratch::new();
    let master = Rosmaster::start(&scratch);
    let rescue = Setup::proxy(&scratch, master.port).start();
    let client = rescue.client();
    let _talker = Node::start(&scratch, Library::Rospy, rescue.port(), "talker", &[]);
    let _listener = Node::start(&scratch, Library::Roscpp, rescue.port(), "listener", &[]);
    let bypassing = || names(&status(&client)["bypassing"]);
    let check = || {
        let tool = Tool::rosrescue(&scratch, rescue.port(), &["check", "--json"]);
        let report: serde_json::Value = serde_json::from_str(&tool.stdout).expect("JSON");
        let findings = report["findings"].as_array().unwrap().clone();
        let said = findings.iter().filter(|it| it["subject"] == "unprotected");
        said.map(|it| it["what"].as_str().unwrap().to_owned())
            .collect::<Vec<_>>()
    };
    // Because of its ROS_IP, rosmaster listens at loopback only.
    assert_eq!(check(), Vec::<String>::new());
    assert_eq!(status(&client)["master_is_open"], false);

    let node = Node::start(
        &scratch,
        Library::Roscpp,
        master.port,
        "talker",
        &["__name:=direct"],
    );
    let who = format!("talker (process {})", node.pid());
    // roscpp keeps its connection to the master for 30 s.
    eventually("the status names the node", || bypassing() == [who.clone()]);
    let shown = Tool::rosrescue(&scratch, rescue.port(), &["status"]).ended(1);
    let said = format!("1 client talks directly to the master, unprotected: {who}.");
    assert!(
        shown.contains(&said) && shown.contains("\nto do "),
        "{shown}"
    );
    assert!(page(&client, "/metrics").contains("\nrosrescue_bypassing 1\n"));
    let found = check();
    let uri = format!("http://127.0.0.1:{}", master.port);
    assert!(
        found.contains(&format!("{who} talks directly to the master at {uri}/")),
        "{found:?}"
    );
    let by_environment = |it: &String| {
        it.starts_with(&format!("talker (process {}, port ", node.pid()))
            && it.ends_with(&format!(
                " was started with ROS_MASTER_URI={uri}, the master behind rosrescue"
            ))
    };
    assert!(found.iter().any(by_environment), "{found:?}");
    assert!(rescue.log().contains("bypasses rosrescue"));

    signal(node.pid(), rustix::process::Signal::KILL);
    eventually("the status no longer names the node", || {
        bypassing().is_empty()
    });
    assert_eq!(check(), Vec::<String>::new());
}

#[test]
fn a_master_that_other_computers_can_reach_is_reported() {
    let scratch = Scratch::new();
    let port = crate::support::free_port();
    let master = Rosmaster::start_with(&scratch, port, |command| {
        // Without ROS_IP rosmaster listens at all addresses.
        command.env_remove("ROS_IP");
    });
    let rescue = Setup::proxy(&scratch, master.port).start();
    eventually("the status reports the open master", || {
        status(&rescue.client())["master_is_open"] == true
    });
    let shown = Tool::rosrescue(&scratch, rescue.port(), &["status"]).ended(0);
    assert!(shown.contains(", open to other computers"), "{shown}");
    let checked = Tool::rosrescue(&scratch, rescue.port(), &["check"]);
    assert!(
        checked
            .stdout
            .contains("accepts connections from other computers"),
        "{checked:?}"
    );
}
