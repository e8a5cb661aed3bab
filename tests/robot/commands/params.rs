//! `params`, and the real `rosparam load`.

use std::fs;

use ros1_master::xmlrpc::Value;

use crate::support::{Mode, Robot, Rosmaster, Tool, kinds, sorted, tree};

#[test]
fn rosparam_loads_what_params_prints() {
    let robot = Robot::start_with(Mode::Core, &["--no-rosout"]);
    let client = robot.client();
    client.set_param("/kinds", kinds());
    client.set_param(
        "/deep",
        tree! { "a" => tree! { "b" => tree! { "c" => 1.0 } } },
    );
    client.set_param("/angle", "deg(90)");
    client.set_param("/secret", "geheim");
    let run = |arguments: &[&str]| Tool::rosrescue(&robot.scratch, robot.port(), arguments);
    let printed = run(&["params", "present"]);
    let of_kinds = ["/kinds/no time", "/kinds/", "/kinds/with/slash"];
    let of_the_session = ["/run_id", "/rosdistro", "/rosversion"];
    for name in of_kinds.into_iter().chain(of_the_session) {
        let said = format!("rosrescue: left out {name}: ");
        assert!(printed.stderr.contains(&said), "{said}\n{}", printed.stderr);
    }
    assert_eq!(printed.stderr.lines().count(), 6, "{}", printed.stderr);
    let yaml = robot.scratch.path("params.yaml");
    fs::write(&yaml, printed.ended(0)).unwrap();

    let other = Rosmaster::start(&robot.scratch);
    let yaml = yaml.to_str().unwrap();
    let load = Tool::run(&robot.scratch, other.port, "rosparam", &["load", yaml]);
    assert!(load.status.success(), "{load:?}");
    let Some(Value::Struct(mut expected)) = client.param("/") else {
        panic!("no parameters");
    };
    for name in of_the_session {
        assert!(
            expected
                .shift_remove(name.trim_start_matches('/'))
                .is_some()
        );
    }
    let Some(Value::Struct(kinds)) = expected.get_mut("kinds") else {
        panic!("no kinds");
    };
    for key in ["no time", "", "with/slash"] {
        assert!(kinds.shift_remove(key).is_some());
    }
    let loaded = other.client().param("/").unwrap();
    assert_eq!(sorted(&loaded), sorted(&Value::Struct(expected)));

    let hidden = run(&["params", "present", "--hide-values", "secret"]);
    assert!(
        hidden.stderr.contains("left out /secret: it is hidden"),
        "{hidden:?}"
    );
    assert!(!hidden.ended(0).contains("secret"));
    let json = run(&["params", "present", "--json"]).json(0);
    assert_eq!(json["secret"], "geheim");
}
