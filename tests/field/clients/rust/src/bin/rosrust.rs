//! A node of rosrust.

use std::time::Instant;
use std::{process, thread};

use foreign_clients::std_msgs::String as Text;
use foreign_clients::std_srvs::{Trigger, TriggerReq, TriggerRes};
use foreign_clients::{name, outcome, say, PAUSE, TICK};

fn forever(what: &'static str, act: impl Fn(i32) -> Result<(), String> + Send + 'static) {
    thread::spawn(move || {
        for number in 1.. {
            let start = Instant::now();
            outcome(what, number, start, act(number));
            thread::sleep(PAUSE);
        }
    });
}

fn main() {
    let name = name();
    rosrust::init(&name);
    let out = rosrust::publish(&format!("/{name}/out"), 100).unwrap();
    let heard = |text: Text| say(format_args!("heard {}", text.data));
    let _in = rosrust::subscribe(&format!("/ref_{name}/out"), 100, heard).unwrap();
    let serve = |_| {
        Ok(TriggerRes {
            success: true,
            ..TriggerRes::default()
        })
    };
    let _service = rosrust::service::<Trigger, _>(&format!("/{name}/serve"), serve).unwrap();
    say("ready");
    let key = format!("/{name}/value");
    forever("param", move |value| {
        let param = rosrust::param(&key).ok_or("no name")?;
        param.set(&value).map_err(|error| error.to_string())?;
        let got: i32 = param.get().map_err(|error| error.to_string())?;
        (got == value).then_some(()).ok_or(format!("got {got}"))
    });
    let server = format!("/ref_{name}/serve");
    forever("call", move |_| {
        let client = rosrust::client::<Trigger>(&server).map_err(|error| error.to_string())?;
        let reply = client.req(&TriggerReq {});
        reply.map_err(|error| error.to_string())?.map(drop)
    });
    let mut number = 0;
    while rosrust::is_ok() {
        number += 1;
        let _ = out.send(Text {
            data: number.to_string(),
        });
        thread::sleep(TICK);
    }
    say("shutdown");
    process::exit(0);
}
