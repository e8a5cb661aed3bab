//! Plans of `install` and `uninstall`.

use super::*;

fn wanted(path: &str, text: &str) -> Wanted {
    Wanted {
        path: path.into(),
        content: text.into(),
        mode: 0o644,
    }
}

fn facts(place: &Place) -> Facts<'_> {
    Facts {
        place,
        wanted: vec![
            wanted("/etc/systemd/system/rosrescue.socket", "socket"),
            wanted("/etc/systemd/system/rosrescue.service", "service"),
        ],
        present: BTreeMap::new(),
        earlier: None,
        found: Vec::new(),
        systemd_runs: true,
        is_running: false,
        is_enabled: false,
        port: 11311,
        port_taken: false,
        proxy: false,
    }
}

fn commands(plan: &Plan) -> Vec<String> {
    let command = |change: &Change| match change {
        Change::Run { command, .. } => Some(command.join(" ")),
        _ => None,
    };
    plan.changes.iter().filter_map(command).collect()
}

/// After `plan`, with other texts.
fn later<'a>(place: &'a Place, plan: &Plan, socket: &str, service: &str) -> Facts<'a> {
    let mut later = facts(place);
    let files = plan.manifest.files.iter();
    let present = |(path, crc): (&PathBuf, &u32)| {
        (
            path.clone(),
            Present {
                crc: *crc,
                text: None,
            },
        )
    };
    later.present = files.map(present).collect();
    later.earlier = Some(plan.manifest.clone());
    (later.is_running, later.is_enabled) = (true, true);
    later.wanted = vec![
        wanted("/etc/systemd/system/rosrescue.socket", socket),
        wanted("/etc/systemd/system/rosrescue.service", service),
    ];
    later
}

#[test]
fn a_service_that_runs_is_renewed_as_gently_as_can_be() {
    let place = Place::system();
    let first = install(&facts(&place), Manifest::default());
    assert_eq!(
        commands(&first),
        [
            "systemctl daemon-reload",
            "systemctl enable --now rosrescue.socket rosrescue.service"
        ]
    );
    let again = install(
        &later(&place, &first, "socket", "service"),
        Manifest::default(),
    );
    assert_eq!(again.changes, []);
    let service = install(&later(&place, &first, "socket", "new"), Manifest::default());
    assert!(commands(&service)[1].starts_with("systemctl kill --signal=KILL --kill-who=main"));
    let socket = install(
        &later(&place, &first, "new", "service"),
        Manifest::default(),
    );
    let restart = [
        "systemctl stop rosrescue.socket",
        "systemctl start rosrescue.socket rosrescue.service",
    ];
    assert_eq!(commands(&socket)[1..], restart);
    let other = Manifest {
        run_as: Some("other".to_owned()),
        ..Manifest::default()
    };
    let user = install(&later(&place, &first, "socket", "new"), other);
    assert_eq!(commands(&user)[1..], restart);
}

#[test]
fn a_master_that_holds_the_port_is_an_obstacle_unless_its_unit_is_known() {
    let place = Place::system();
    let mut facts = facts(&place);
    facts.port_taken = true;
    assert!(install(&facts, Manifest::default()).obstacles[0].contains("port 11311 is in use"));
    let roscore = Found {
        unit: "roscore.service".to_owned(),
        path: "/etc/systemd/system/roscore.service".to_owned(),
        kind: Kind::Master,
        of_user: false,
        enabled: true,
        active: true,
    };
    facts.found = vec![roscore.clone()];
    let plan = install(&facts, Manifest::default());
    assert_eq!(plan.obstacles, Vec::<String>::new());
    assert!(commands(&plan).contains(&"systemctl disable --now roscore.service".to_owned()));
    let back = uninstall(&place, &plan.manifest, &BTreeMap::new(), true);
    assert!(commands(&back).contains(&"systemctl enable --now roscore.service".to_owned()));
    // Not ours to stop.
    facts.found = vec![Found {
        of_user: true,
        ..roscore
    }];
    let plan = install(&facts, Manifest::default());
    assert!(
        plan.obstacles[0].contains("`systemctl --user disable --now roscore.service`"),
        "{plan}"
    );
}

#[test]
fn a_copy_that_is_not_needed_any_more_goes() {
    let place = Place::system();
    let mut with_copy = facts(&place);
    with_copy
        .wanted
        .push(wanted("/usr/local/bin/rosrescue", "program"));
    let first = install(&with_copy, Manifest::default());
    let then = install(
        &later(&place, &first, "socket", "service"),
        Manifest::default(),
    );
    let path = PathBuf::from("/usr/local/bin/rosrescue");
    assert_eq!(then.changes[0], Change::Remove { path });
}
