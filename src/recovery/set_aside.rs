//! What becomes of a record that every new master dies of.

use crate::{master::Told, proxy::Proxy, record, xmlrpc::Call};

/// The first line of the file.
const COMMENT: &str = "Calls that rosrescue no longer makes: each new master died of them.";

/// Writes `calls` into a file beside the checkpoint and says so everywhere. The caller takes them out
/// of the mirror, and so out of the checkpoint. Answers with their names.
pub(super) fn set_aside(proxy: &Proxy, calls: &[Call]) -> Vec<String> {
    if calls.is_empty() {
        return Vec::new();
    }
    let kept = match record::encode_calls(COMMENT, calls) {
        Err(error) => Err(error.to_string()),
        Ok(bytes) => proxy
            .shadow
            .with_store(|store, _| store.keep_beside("set-aside", &bytes))
            .unwrap_or_else(|| {
                Err(crate::store::StoreError::Unprotected {
                    path: proxy.config.checkpoint.clone(),
                    reason: "it could not be opened".to_owned(),
                })
            })
            .map_err(|error| error.to_string()),
    };
    for call in calls {
        proxy.nodes.forbid(call);
    }
    let names: Vec<_> = calls.iter().map(|call| Told(call).to_string()).collect();
    for name in &names {
        match &kept {
            Ok(path) => tracing::error!(
                file = %path.display(),
                "set aside: {name}. Each new master died of it, and none of the rest; it is kept in \
                 the file. Whoever makes it again makes it as any call"
            ),
            Err(error) => tracing::error!(
                error,
                "set aside: {name}. Each new master died of it, and none of the rest; it cannot be \
                 kept in a file"
            ),
        }
        proxy.board.add_set_aside(name.clone());
    }
    names
}
