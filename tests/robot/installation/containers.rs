//! The files for Docker and Kubernetes. The test does not run them: it reads them as their tools would, and
//! checks that everything they name exists.

use std::{fs, process::Command};

use serde_json::Value;

use crate::support::Scratch;

const ROOT: &str = env!("CARGO_MANIFEST_DIR");
const READ: &str =
    "import json, sys, yaml; print(json.dumps(list(yaml.safe_load_all(open(sys.argv[1])))))";

/// The documents in a YAML file.
fn read(name: &str) -> Vec<Value> {
    let output = Command::new("/usr/bin/python3")
        .args(["-c", READ, &format!("{ROOT}/packaging/{name}")])
        .output()
        .unwrap();
    let errors = String::from_utf8_lossy(&output.stderr);
    assert!(output.status.success(), "{name}: {errors}");
    serde_json::from_slice(&output.stdout).unwrap()
}

fn texts(list: &Value) -> Vec<&str> {
    let list = list.as_array().into_iter().flatten();
    list.map(|text| text.as_str().unwrap()).collect()
}

/// Checks that the program accepts this command line.
#[track_caller]
fn is_understood(command: &[&str]) {
    let ["rosrescue", arguments @ ..] = command else {
        return;
    };
    let mut program = Command::new(env!("CARGO_BIN_EXE_rosrescue"));
    let output = program.args(arguments).arg("--help").output().unwrap();
    let errors = String::from_utf8_lossy(&output.stderr);
    assert!(output.status.success(), "{command:?}: {errors}");
}

/// Checks that a health check is about answers to calls alone. `rosrescue status` also fails for one dead node, and
/// while rosrescue stands in: a restart of the container would then end the only program that answers.
#[track_caller]
fn counts_answers(check: &[&str]) {
    assert_eq!(check[..2], ["rosrescue", "wait"]);
    assert!(!check.contains(&"--for"), "{check:?}");
    is_understood(check);
}

#[test]
fn the_image_is_healthy_while_calls_are_answered() {
    let file = fs::read_to_string(format!("{ROOT}/packaging/docker/Dockerfile")).unwrap();
    let (_, check) = file.split_once("\nHEALTHCHECK --interval=5s CMD ").unwrap();
    let check = serde_json::from_str(check.lines().next().unwrap()).unwrap();
    counts_answers(&texts(&check));
}

/// The hosts in a list of `http://HOST:PORT`, each optionally as `NAME=…`.
fn hosts(list: &str) -> Vec<&str> {
    let hosts = list.split(',').map(|url| {
        let (_, rest) = url.split_once("http://").expect(url);
        rest.split(':').next().unwrap()
    });
    hosts.collect()
}

/// `setup.bash` of catkin would take `-h` for a call for help, and the container would end.
#[test]
fn the_image_gives_options_to_its_command_alone() {
    let scratch = Scratch::new();
    let setup = scratch.path("noetic/setup.bash");
    fs::create_dir_all(setup.parent().unwrap()).unwrap();
    fs::write(&setup, "given=\"$*\"\nexport given\n").unwrap();
    let script = fs::read_to_string(format!("{ROOT}/packaging/docker/in_ros")).unwrap();
    let folder = scratch.path("");
    let script = script.replace("/opt/ros/", folder.to_str().unwrap());
    let output = Command::new("bash")
        .args(["-c", &script, "in_ros", "sh", "-c"])
        .args(["echo \"$given\" for setup.bash, $1", "sh", "-h"])
        .output()
        .unwrap();
    let said = String::from_utf8_lossy(&output.stdout);
    assert_eq!(said, "-- for setup.bash, -h\n", "{output:?}");
}

#[test]
fn services_in_the_compose_files_refer_to_existing_services() {
    for name in ["docker/compose.yaml", "docker/compose.cluster.yaml"] {
        let file = &read(name)[0];
        let services = file["services"].as_object().unwrap();
        for (service, of) in services {
            // The network of a compose file knows a service by its name.
            assert_eq!(of["hostname"], service.as_str(), "{name}");
            for other in texts(&of["depends_on"]) {
                assert!(services.contains_key(other), "{name}: {other}");
            }
            for volume in texts(&of["volumes"]) {
                let volume = volume.split(':').next().unwrap();
                assert!(file["volumes"].get(volume).is_some(), "{name}: {volume}");
            }
            if let Some(uri) = of["environment"]["ROS_MASTER_URI"].as_str() {
                assert!(services.contains_key(hosts(uri)[0]), "{name}: {uri}");
            }
            let command: Vec<_> = of["command"]
                .as_str()
                .into_iter()
                .flat_map(str::split_whitespace)
                .collect();
            is_understood(&command);
            let check = texts(&of["healthcheck"]["test"]);
            if let ["CMD", check @ ..] = &*check {
                counts_answers(check);
            }
        }
    }
}

#[test]
fn the_compose_file_for_several_computers_names_the_same_etcd_everywhere() {
    let file = &read("docker/compose.cluster.yaml")[0];
    let services = file["services"].as_object().unwrap();
    let all = ["etcd-a", "etcd-b", "etcd-c"];
    for name in all {
        let settings = &services[name]["environment"];
        let text = |name: &str| settings[name].as_str().unwrap();
        assert_eq!(text("ETCD_NAME"), name);
        assert_eq!(hosts(text("ETCD_INITIAL_CLUSTER")), all);
        assert_eq!(hosts(text("ETCD_ADVERTISE_CLIENT_URLS")), [name]);
        assert_eq!(hosts(text("ETCD_INITIAL_ADVERTISE_PEER_URLS")), [name]);
    }
    for name in ["ros-a", "ros-b", "ros-c"] {
        let command = services[name]["command"].as_str().unwrap();
        let (_, members) = command.split_once("--cluster ").unwrap();
        assert_eq!(hosts(members), all);
    }
}

#[test]
fn the_kubernetes_pods_share_one_etcd_and_have_working_probes() {
    let file = read("kubernetes/rosrescue.yaml");
    let kind = |kind: &str, name: &str| {
        let is_it = |of: &&Value| of["kind"] == kind && of["metadata"]["name"] == name;
        file.iter()
            .find(is_it)
            .unwrap_or_else(|| panic!("there is no {kind} {name}"))
    };
    let set = &kind("StatefulSet", "rosrescue")["spec"];
    let template = &set["template"];
    let labels = &template["metadata"]["labels"];
    assert_eq!(&set["selector"]["matchLabels"], labels);
    for service in ["rosrescue", "ros"] {
        assert_eq!(&kind("Service", service)["spec"]["selector"], labels);
    }
    let headless = set["serviceName"].as_str().unwrap();
    let headless = &kind("Service", headless)["spec"];
    assert!(headless["clusterIP"] == "None" && headless["publishNotReadyAddresses"] == true);
    let pods: Vec<_> = (0..set["replicas"].as_u64().unwrap())
        .map(|number| format!("rosrescue-{number}.rosrescue"))
        .collect();
    let [etcd, rosrescue] = template["spec"]["containers"]
        .as_array()
        .unwrap()
        .as_slice()
    else {
        panic!("{template}");
    };
    let option = |list: &Value, name: &str| {
        let list = texts(list);
        let found = list.into_iter().find_map(|text| text.strip_prefix(name));
        found
            .unwrap_or_else(|| panic!("there is no {name}"))
            .to_owned()
    };
    assert_eq!(hosts(&option(&etcd["command"], "--initial-cluster=")), pods);
    assert_eq!(hosts(&option(&rosrescue["args"], "--cluster=")), pods);
    is_understood(&texts(&rosrescue["args"]));
    let port = rosrescue["ports"][0]["name"].as_str().unwrap();
    for (probe, path) in [("readinessProbe", "/ready"), ("livenessProbe", "/live")] {
        let get = &rosrescue[probe]["httpGet"];
        assert!(get["path"] == path && get["port"] == port, "{get}");
    }
}
