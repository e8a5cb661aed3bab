//! The instructions in `docs/several-computers.md` work on three computers, which
//! `tests/support/computers.sh` provides with real etcd servers and a real keepalived.

use std::{fs, path::Path};

use super::{documents::run_on_a_computer, support::blocks};

const ROOT: &str = env!("CARGO_MANIFEST_DIR");
const COMPUTERS: [(&str, &str); 3] = [
    ("base", "10.0.0.1"),
    ("arm", "10.0.0.2"),
    ("head", "10.0.0.3"),
];
const ALL: [&str; 3] = ["base", "arm", "head"];

/// The document, whose commands are read section by section.
struct Document(String);

impl Document {
    fn new() -> Self {
        Self(fs::read_to_string(Path::new(ROOT).join("docs/several-computers.md")).unwrap())
    }

    /// The contents of the `text` fence whose first line starts with `first`.
    fn text(&self, first: &str) -> String {
        let (_, rest) = self.0.split_once(&format!("```text\n{first}")).unwrap();
        format!("{first}{}", rest.split("```").next().unwrap())
    }

    /// The command blocks of `section`, which must have exactly `COUNT` of them.
    fn section<const COUNT: usize>(&self, section: &str) -> [String; COUNT] {
        let blocks = blocks(&self.0);
        let blocks = blocks.into_iter().filter(|block| block.section == section);
        let texts: Vec<_> = blocks.map(|block| block.text).collect();
        texts.try_into().unwrap_or_else(|texts: Vec<_>| {
            panic!("`{section}` has {} blocks, not {COUNT}", texts.len())
        })
    }
}

/// A script that runs `text` on each of `computers`. Its first line is changed for each computer, as the document says.
fn on(computers: &[&str], text: &str) -> String {
    let own = COMPUTERS
        .iter()
        .filter(|(name, _)| computers.contains(name));
    let scripts = own.map(|(name, address)| {
        let text = text
            .replace(
                "name=base address=10.0.0.1",
                &format!("name={name} address={address}"),
            )
            .replace("name=base\n", &format!("name={name}\n"));
        format!("on {name} <<'SCRIPT'\n{text}\nSCRIPT\n")
    });
    scripts.collect()
}

/// Runs `script` with the functions of `tests/support/computers.sh`.
#[track_caller]
fn run(script: &str) -> String {
    run_on_a_computer(&format!(
        "exec 2>&1\n. tests/support/computers.sh\n{script}"
    ))
}

/// A script for steps 1 to 3, which then waits until a majority has formed.
fn three_etcd(document: &Document) -> String {
    let [install, settings, start, _] = document.section("etcd on three computers");
    let steps = [install, settings, start]
        .map(|step| on(&ALL, &step))
        .concat();
    steps + "within 120 all_healthy http\n"
}

#[test]
fn etcd_can_be_set_up_and_a_member_replaced_as_documented() {
    let document = Document::new();
    let [_, settings, start, look] = document.section("etcd on three computers");
    let [replace] = document.section("One etcd is replaced");
    let new = settings.replace("STATE=new", "STATE=existing");
    assert_ne!(new, settings, "the text to change is not in the document");
    let said = run(&[
        three_etcd(&document),
        on(&["arm"], &look),
        // The disk of the old member is lost too.
        on(
            &["head"],
            "sudo systemctl stop etcd\nrm -r /var/lib/etcd/robot",
        ),
        on(&["base"], &replace),
        on(&["head"], &(new + &start)),
        "within 120 all_healthy http\n".to_owned(),
        on(&["head"], &look),
    ]
    .concat());
    assert_eq!(said.matches("is healthy").count(), 6, "{said}");
    assert_eq!(said.matches(", started, ").count(), 6, "{said}");
}

#[test]
fn a_full_etcd_can_be_emptied_as_documented() {
    let document = Document::new();
    let [_, settings, ..] = document.section::<4>("etcd on three computers");
    let small = settings.replace(
        "ETCD_ELECTION",
        "ETCD_QUOTA_BACKEND_BYTES=8000000\nETCD_ELECTION",
    );
    let [install, _, start, _] = document.section("etcd on three computers");
    let [make_room] = document.section("etcd's settings");
    let put = "head -c 1000000 /dev/zero | tr '\\0' x | ETCDCTL_API=3 etcdctl --endpoints=10.0.0.2:2379 put /robot/big\n";
    let fill = format!(
        "for _ in $(seq 40); do {} done\nexit 1",
        put.replace('\n', " || exit 0;")
    );
    let said = run(&[
        [install, small, start].map(|step| on(&ALL, &step)).concat(),
        "within 120 all_healthy http\n".to_owned(),
        on(&["base"], &fill),
        on(&["base"], &make_room),
        on(&["base"], put),
    ]
    .concat());
    assert!(said.contains("alarm:NOSPACE"), "{said}");
}

#[test]
fn certificates_and_users_can_be_made_as_documented() {
    let document = Document::new();
    let [authority, bring, look] = document.section("TLS");
    let [users] = document.section("Users");
    let [install, settings, _, _] = document.section("etcd on three computers");
    let as_robot = "etcdctl --user robot:ANOTHER put /robot/x 1\n\
                    if etcdctl --user robot:ANOTHER put /other/x 1; then exit 1; fi\n";
    let options = document.text("ROSRESCUE_CLUSTER=https://");
    let start = format!(
        "echo ANOTHER >password\nset -a\n{options}ROSRESCUE_CLUSTER_USER=robot\n\
         ROSRESCUE_CLUSTER_PASSWORD_FILE=$PWD/password\nset +a\nrosrescue core"
    );
    // On a busy computer one that has just started may be cut off for a moment.
    let handover =
        "for _ in $(seq 300); do if rosrescue handover; then exit; fi; sleep 0.2; done\nexit 1";
    let said = run(&[
        [install, settings].map(|step| on(&ALL, &step)).concat(),
        on(&["base"], &authority),
        "for name in arm head; do cp \"$scratch\"/base/*.{pem,key} \"$scratch/$name\"; done\n"
            .to_owned(),
        on(&ALL, &bring),
        "within 120 all_healthy https\n".to_owned(),
        on(&["head"], &(look + &users + as_robot)),
        on(&ALL, &start),
        on(&["head"], handover),
    ]
    .concat());
    assert_eq!(said.matches("is healthy").count(), 3, "{said}");
    assert!(said.contains("base-10.0.0.1 led, "), "{said}");
    assert!(said.contains("Authentication Enabled"), "{said}");
}

#[test]
fn rosrescue_can_be_run_and_handed_over_as_documented() {
    let document = Document::new();
    let [core, _, _, check] = document.section("rosrescue");
    let [look] = document.section("Try it");
    let said = run(&[
        three_etcd(&document),
        on(&ALL, &core),
        // A computer that has just started may not know the others yet.
        on(
            &["head"],
            &format!("rosrescue wait --for protected\n{look}"),
        ),
        // The exit status depends on whether the next master already answers, which the test does not check.
        on(&["base"], "rosrescue status || true"),
        // On such a computer `check` has further findings.
        on(&["head"], &format!("{} || true", check.trim_end())),
    ]
    .concat());
    assert!(
        said.contains("base-10.0.0.1 led, ") && said.contains("leads now, after"),
        "{said}"
    );
    assert!(
        said.contains("base-10.0.0.1 (this one) is following"),
        "{said}"
    );
    assert!(said.contains("all 3 members of etcd answer"), "{said}");
    assert!(said.contains("etcd has the robot robot, "), "{said}");
}

#[test]
fn the_virtual_address_moves_away_from_a_computer_that_is_cut_off_or_without_rosrescue() {
    let document = Document::new();
    let said = run(&[
        three_etcd(&document),
        "cluster=http://10.0.0.1:2379,http://10.0.0.2:2379,http://10.0.0.3:2379/robot\n".to_owned(),
        ". tests/support/virtual_address.sh\n".to_owned(),
    ]
    .concat());
    println!("{said}");
    assert_eq!(said.matches(" ms\n").count(), 2, "{said}");
}
