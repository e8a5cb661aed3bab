//! For which methods the master has answered differently from the mirror: whether it must be read for that, and the log
//! line.

use std::collections::HashSet;

use rescue_core::replay::Answered;
use ros1_master::{
    master::Method,
    xmlrpc::{Reply, Value},
};

/// Maximum number of bytes of a reply in a log line.
const LOGGED_REPLY: usize = 300;

/// Summarizes a reply for the log, without parameter values.
fn summary(method: &Method, reply: &Reply) -> String {
    let text = match reply {
        Reply::Value(Value::Array(answer)) if *method == Method::SubscribeParam => {
            let said = answer.get(..2).unwrap_or_default();
            format!("{said:?} and a value")
        }
        reply => format!("{reply:?}"),
    };
    cut(&text).to_owned()
}

fn cut(text: &str) -> &str {
    let end = (0..=LOGGED_REPLY)
        .rev()
        .find(|end| text.is_char_boundary(*end))
        .unwrap_or(0);
    text.get(..end.min(text.len())).unwrap_or(text)
}

/// The methods for which the mirror has replied differently from a master.
#[derive(Default)]
pub(super) struct Divergences {
    logged: HashSet<Method>,
    /// Those for which only the text of the reply differed.
    in_words: HashSet<Method>,
}

impl Divergences {
    /// Whether the master uses other words than the mirror, and is known to do so for this method. The first time the
    /// words may be about another state, and the master must be read.
    pub(super) fn knows_words(&mut self, answered: &Answered<'_>, mirror: &Reply) -> bool {
        answered.differs_in_words(mirror) && !self.in_words.insert(answered.call.method().clone())
    }

    /// Logs the first divergence of each method.
    pub(super) fn report(&mut self, answered: &Answered<'_>, mirror: &Reply) {
        let method = answered.call.method();
        if self.logged.insert(method.clone()) {
            let [master, mirror] = [&answered.reply, mirror].map(|reply| summary(method, reply));
            tracing::warn!(
                method = method.name(),
                mirror,
                master,
                "the mirror's reply differs from the master's; the caller gets the master's, and the mirror is rebuilt. Please report this line (it is logged once per method)"
            );
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn long_replies_are_cut_at_a_character() {
        let text = "ä".repeat(LOGGED_REPLY);
        assert_eq!(cut(&text).len(), LOGGED_REPLY);
        assert_eq!(cut("short"), "short");
    }
}
