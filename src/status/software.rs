//! HTTP and Python versions of a master, and what follows from them.

/// Describes HTTP version and Python version of a master for people. The HTTP version follows from whether the master
/// keeps connections open, the Python version from its `Server` header.
pub(crate) fn speaks(keeps_alive: bool, server: Option<&str>) -> String {
    let http = match keeps_alive {
        true => "HTTP/1.1",
        false => "HTTP/1.0 (a connection for each call)",
    };
    let python = server
        .into_iter()
        .flat_map(str::split_whitespace)
        .find_map(|word| word.strip_prefix("Python/"));
    match python {
        Some(two) if two.starts_with("2.") => {
            format!("{http}, Python {two} (lists and structs in an order of its own)")
        }
        Some(python) => format!("{http}, Python {python}"),
        None => http.to_owned(),
    }
}

/// Whether the rosmaster of ros_comm `release` keeps connections open on this kernel. `None` if either version cannot
/// be read. Releases before 1.14 never do. Releases since 1.14.11 and 1.15.10 do from Linux 4.16 on.
pub(crate) fn keeps_alive(release: &str, kernel: &str) -> Option<bool> {
    let (major, minor, patch) = numbers(release)?;
    Some(match (major, minor) {
        (..1, _) | (1, ..14) => false,
        (1, 14) if patch < 11 => true,
        (1, 15) if patch < 10 => true,
        _ => {
            let (major, minor, _) = numbers(kernel)?;
            (major, minor) >= (4, 16)
        }
    })
}

fn numbers(version: &str) -> Option<(u32, u32, u32)> {
    let mut numbers = version.split(|c: char| !c.is_ascii_digit());
    let mut next = || numbers.next()?.parse().ok();
    Some((next()?, next()?, next().unwrap_or(0)))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_it_speaks_and_what_follows() {
        let python_3 = Some("BaseHTTP/0.6 Python/3.11.2");
        assert_eq!(speaks(true, python_3), "HTTP/1.1, Python 3.11.2");
        let old = speaks(false, Some("BaseHTTP/0.3 Python/2.7.18"));
        assert!(old.starts_with("HTTP/1.0 (") && old.contains("Python 2.7.18 ("));
        assert_eq!(speaks(true, None), "HTTP/1.1");
    }

    #[test]
    fn releases_and_kernels() {
        for (release, kernel, keeps) in [
            ("1.12.17", "6.1.0-18-amd64", Some(false)),
            ("1.14.3", "4.9.337-tegra", Some(true)),
            ("1.14.13", "4.9.337-tegra", Some(false)),
            ("1.15.9", "4.15.0-20-generic", Some(true)),
            ("1.15.15", "4.15.0-20-generic", Some(false)),
            ("1.15.15", "4.16", Some(true)),
            ("1.17.0", "6.12.1", Some(true)),
            ("unknown", "6.12.1", None),
            ("1.17.0", "", None),
        ] {
            assert_eq!(keeps_alive(release, kernel), keeps, "{release} on {kernel}");
        }
    }
}
