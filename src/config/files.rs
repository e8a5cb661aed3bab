//! Limits client connections so that enough file descriptors remain.

use super::Config;

/// File descriptors reserved for nodes: health check and notifications open up to 320 at a time.
const RESERVED: u64 = 320;
/// If the process may open only few files, clients get one descriptor in four. The checkpoint, the
/// connections to the master and its process take some 30 of the rest; health check and
/// notifications share the others and retry.
const SHARE: u64 = 4;
/// Client connections that are always allowed, unless fewer are configured.
const FEWEST: u64 = 16;

impl Config {
    /// Lowers the number of client connections so that descriptors remain for the master, the nodes
    /// and the checkpoint, given the process's limit of `files`.
    pub fn fit_into(&mut self, files: u64) {
        let most = files
            .saturating_sub(RESERVED)
            .max(files / SHARE)
            .max(FEWEST);
        let most = usize::try_from(most).unwrap_or(usize::MAX);
        self.max_connections = self.max_connections.min(most);
    }
}

#[cfg(test)]
mod tests {
    use clap::Parser;

    use super::*;
    use crate::cli::Cli;

    #[test]
    fn few_files_are_shared_and_clients_always_get_some() {
        let config = Config::core(
            &Cli::parse_from(["rosrescue"]).core,
            &|_| None,
            "robot",
            None,
        );
        let config = config.unwrap();
        for (files, connections) in [
            (20, 16),
            (64, 16),
            (128, 32),
            (200, 50),
            (1024, 704),
            (1 << 20, 10_000),
        ] {
            let mut config = config.clone();
            config.fit_into(files);
            assert_eq!(config.max_connections, connections, "{files}");
        }
    }
}
