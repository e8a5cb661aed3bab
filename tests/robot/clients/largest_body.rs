//! The largest body that passes.

use crate::support::{Rosmaster, Scratch, Setup, encode_call, http_request, params};

/// The default of `--max-body`.
const LIMIT: usize = 64 << 20;

#[test]
fn a_body_of_just_the_limit_passes_and_one_byte_more_does_not() {
    let scratch = Scratch::new();
    let master = Rosmaster::start(&scratch);
    let rescue = Setup::proxy(&scratch, master.port).start();
    let client = rescue.client();
    // What the master does with it takes no time: it knows no such method.
    let of_length = |length: usize| {
        let around = encode_call("noSuchMethod", params![""]).len();
        encode_call("noSuchMethod", params!["x".repeat(length - around)])
    };
    let body = of_length(LIMIT);
    assert_eq!(body.len(), LIMIT);
    let answer = client.exchange(&http_request(&body)).unwrap();
    let small = master.client().call("noSuchMethod", params![]).unwrap();
    assert_eq!(answer.reply(), small);

    // The head alone is enough: it says how long the body is.
    let body = of_length(LIMIT + 1);
    let request = http_request(&body);
    let mut wire = client.connect().unwrap();
    wire.send(&request[..request.len() - body.len()]).unwrap();
    assert_eq!(wire.response().unwrap().code, 413);
}
