//! Access to etcd with users, passwords and certificates.

use std::{
    path::Path,
    process::Command,
    time::{Duration, Instant},
};

use rosrescue::cluster::etcd::{Credentials, Etcd, EtcdError, Options, Tls};
use serde_json::json;

use crate::{
    servers::{LIMIT, Servers, keys, with_user},
    support::Scratch,
};

#[tokio::test]
async fn a_user_needs_its_password_and_an_expired_token_is_renewed() {
    let expires = ["--auth-token-ttl", "2"];
    let servers = Servers::with(Scratch::new(), 1, "http", &expires).await;
    for (path, body) in [
        (
            "auth/user/add",
            json!({ "name": "root", "password": "secret" }),
        ),
        ("auth/role/add", json!({ "name": "root" })),
        ("auth/user/grant", json!({ "user": "root", "role": "root" })),
        (
            "auth/user/add",
            json!({ "name": "guest", "password": "guest" }),
        ),
        ("auth/enable", json!({})),
    ] {
        let answer = servers.post(path, &body);
        assert!(answer.get("error").is_none(), "{path}: {answer}");
    }
    let keys = keys();
    for (access, refused) in [
        (Credentials::default(), "user name is empty"),
        (with_user("root", "wrong"), "authentication failed"),
        (with_user("guest", "guest"), "permission denied"),
    ] {
        let error = servers
            .client_of(0, access)
            .view(&keys, LIMIT)
            .await
            .unwrap_err();
        assert!(matches!(error, EtcdError::Access { .. }), "{error}");
        let said = error.to_string();
        assert!(
            said.contains(refused) && said.contains("check user, password"),
            "{said}"
        );
    }
    let client = servers.client_of(0, with_user("root", "secret"));
    client.view(&keys, LIMIT).await.unwrap();
    let mut watch = client.watch(keys.small(), 0, Duration::from_secs(1));
    // Tokens expire after 2 s without use, and when the member that issued them ends.
    let start = Instant::now();
    while start.elapsed() < Duration::from_secs(4) {
        let _ = tokio::time::timeout(Duration::from_secs(4), watch.next()).await;
    }
    client.view(&keys, LIMIT).await.unwrap();
    assert!(!format!("{:?}", with_user("root", "secret")).contains("secret"));
}

/// etcd's gateway is a client of its own server, so a certificate for servers only is not enough.
async fn for_servers_alone(access: Credentials, folder: &Path) {
    std::fs::write(folder.join("usage"), "extendedKeyUsage=serverAuth\n").unwrap();
    certificate(folder, "half", "ca", 9);
    let file = |name: &str| folder.join(name).to_str().unwrap().to_owned();
    let (cert, key, ca) = (file("half.pem"), file("half.key"), file("ca.pem"));
    let arguments = [
        "--cert-file",
        &cert,
        "--key-file",
        &key,
        "--client-cert-auth",
        "--trusted-ca-file",
        &ca,
    ];
    let servers = Servers::with(Scratch::new(), 1, "https", &arguments).await;
    let client = servers.client_of(0, access);
    let start = Instant::now();
    loop {
        let limit = Duration::from_secs(2);
        let error = client.view(&keys(), limit).await.unwrap_err();
        if error.to_string().contains("good for clients, too") {
            break;
        }
        // etcd may still be starting.
        assert!(start.elapsed() < LIMIT, "{error}");
    }
}

/// Runs openssl in `folder`.
fn openssl(folder: &Path, arguments: &str) {
    let output = Command::new("openssl")
        .current_dir(folder)
        .args(arguments.split(' '))
        .output();
    let output = output.expect("openssl is not installed");
    assert!(
        output.status.success(),
        "{}",
        String::from_utf8_lossy(&output.stderr)
    );
}

/// Makes a certificate `name`, valid for `days` from now on, signed with the certificate of `ca`.
fn certificate(folder: &Path, name: &str, ca: &str, days: i32) {
    let new = "req -newkey ec -pkeyopt ec_paramgen_curve:prime256v1 -nodes";
    openssl(
        folder,
        &format!("{new} -keyout {name}.key -out {name}.csr -subj /CN={name}"),
    );
    let usage = std::fs::read_to_string(folder.join("usage")).unwrap_or_default();
    let names = format!("subjectAltName=IP:127.0.0.1\n{usage}");
    std::fs::write(folder.join("names"), names).unwrap();
    openssl(
        folder,
        &format!(
            "x509 -req -in {name}.csr -CA {ca}.pem -CAkey {ca}.key -CAcreateserial -days {days} \
             -extfile names -out {name}.pem"
        ),
    );
}

fn authority(folder: &Path, name: &str) {
    let new = "req -x509 -newkey ec -pkeyopt ec_paramgen_curve:prime256v1 -nodes -days 9";
    openssl(
        folder,
        &format!("{new} -keyout {name}.key -out {name}.pem -subj /CN={name}"),
    );
}

#[tokio::test]
async fn certificates_are_checked_on_both_sides() {
    let scratch = Scratch::new();
    let folder = scratch.path("");
    for name in ["ca", "other"] {
        authority(&folder, name);
    }
    certificate(&folder, "server", "ca", 9);
    certificate(&folder, "client", "ca", 9);
    certificate(&folder, "expired", "ca", -1);
    certificate(&folder, "stranger", "other", 9);
    let file = |name: &str| folder.join(name).to_str().unwrap().to_owned();
    let (cert, key, ca) = (file("server.pem"), file("server.key"), file("ca.pem"));
    let arguments = [
        "--cert-file",
        &cert,
        "--key-file",
        &key,
        "--client-cert-auth",
        "--trusted-ca-file",
        &ca,
    ];
    let servers = Servers::with(scratch, 1, "https", &arguments).await;
    let access = |ca: &str, own: Option<&str>| Credentials {
        tls: Tls {
            ca: Some(folder.join(format!("{ca}.pem"))),
            cert: own.map(|own| folder.join(format!("{own}.pem"))),
            key: own.map(|own| folder.join(format!("{own}.key"))),
        },
        user: None,
    };
    let client = |access: Credentials| servers.client_of(0, access);
    client(access("ca", Some("client")))
        .view(&keys(), LIMIT)
        .await
        .unwrap();
    // Each error comes at its end.
    let limit = Duration::from_secs(3);
    for (ca, own) in [
        ("other", Some("client")),
        ("ca", None),
        ("ca", Some("expired")),
        ("ca", Some("stranger")),
    ] {
        let start = Instant::now();
        let error = loop {
            let client = client(access(ca, own));
            let error = client.view(&keys(), limit).await.unwrap_err();
            // On a busy computer the handshake may take too long.
            let is_silent = matches!(error, EtcdError::Silent { .. });
            if !is_silent || start.elapsed() > LIMIT {
                break error;
            }
        };
        assert!(
            matches!(error, EtcdError::Tls { .. }),
            "{ca} {own:?}: {error}"
        );
        assert!(
            error
                .to_string()
                .contains("check the certificates and their dates"),
            "{error}"
        );
    }
    // An expired certificate is replaced while rosrescue runs.
    let renewed = client(access("ca", Some("expired")));
    assert!(renewed.view(&keys(), limit).await.is_err());
    certificate(&folder, "expired", "ca", 9);
    renewed.view(&keys(), LIMIT).await.unwrap();
    for_servers_alone(access("ca", Some("client")), &folder).await;
    let options = |access: Credentials, url: &str| Options {
        endpoints: vec![url.to_owned()],
        access,
    };
    let half = Credentials {
        tls: Tls {
            key: None,
            ..access("ca", Some("client")).tls
        },
        user: None,
    };
    for (options, said) in [
        (
            options(Credentials::default(), "https://127.0.0.1:1"),
            "needs the certificate of etcd's authority",
        ),
        (options(half, "https://127.0.0.1:1"), "needs its key"),
        (
            options(access("nothing", None), "https://127.0.0.1:1"),
            "nothing.pem cannot be used",
        ),
        (
            options(access("names", None), "https://127.0.0.1:1"),
            "cannot be used",
        ),
        (
            options(Credentials::default(), "127.0.0.1:1"),
            "is not an etcd endpoint",
        ),
        (
            Options {
                endpoints: Vec::new(),
                access: Credentials::default(),
            },
            "no etcd endpoint is given",
        ),
    ] {
        let error = Etcd::new(&options).unwrap_err().to_string();
        assert!(error.contains(said), "{error}");
    }
}
