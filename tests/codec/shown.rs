//! Texts as Python shows them in an error.

use rosrescue::master::Master;
use rosrescue::xmlrpc::{Call, Reply, Struct, Value};

use super::peer::{Peer, unhex};

/// The fault of a parameter's name shows its `repr`; this one has every character, piece by piece.
#[test]
fn every_character_is_shown_as_python_shows_it() {
    let mut peer = Peer::start();
    let characters: Vec<char> = ('\0'..=char::MAX).filter(|&c| c != '/').collect();
    for piece in characters.chunks(2000) {
        let piece: String = piece.iter().collect();
        let answer = peer.ask("repr", format!("x{piece}").as_bytes());
        let mut texts = answer.split(' ').map(|text| {
            let bytes = unhex(text);
            String::from_utf8(bytes).unwrap()
        });
        let (theirs, known) = (texts.next().unwrap(), texts.next().unwrap());
        let mut master = Master::default();
        let key = format!("/k/{known}/c");
        let params = vec!["/s".into(), "http://127.0.0.1:1/".into(), key.into()];
        master.apply(&Call::new("subscribeParam", params));
        let odd = Struct::from([(format!("{known}/c"), Value::Int(1))]);
        let params = vec!["/n".into(), "/k".into(), Value::Struct(odd)];
        let reply = master.apply(&Call::new("setParam", params)).reply;
        let text = format!("Internal failure: {theirs}");
        let expected = Value::Array(vec![0.into(), text.into(), 0.into()]);
        assert!(reply == Reply::Value(expected), "{theirs}\n{reply:?}");
    }
}
