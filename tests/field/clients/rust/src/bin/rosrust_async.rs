//! A node of rosrust_async.

use std::sync::Arc;
use std::time::Instant;

use foreign_clients::std_msgs::String as Text;
use foreign_clients::std_srvs::{Trigger, TriggerReq, TriggerRes};
use foreign_clients::{name, outcome, say, PAUSE, TICK};
use rosrust_async::node::builder::NodeBuilder;

#[tokio::main]
async fn main() -> anyhow::Result<()> {
    let name = name();
    let node = Arc::new(NodeBuilder::new().name(format!("/{name}")).build().await?);
    let out = node
        .publish::<Text>(format!("/{name}/out"), 100, false, false)
        .await?;
    let heard = |text: Text| async move { say(format_args!("heard {}", text.data)) };
    node.subscribe_callback(format!("/ref_{name}/out"), 100, false, heard)
        .await?;
    let serve = |_| async {
        Ok(TriggerRes {
            success: true,
            ..TriggerRes::default()
        })
    };
    let service = format!("/{name}/serve");
    let _service = node
        .advertise_service::<Trigger, _, _>(service, serve)
        .await?;
    say("ready");
    let (own, key) = (Arc::clone(&node), format!("/{name}/value"));
    tokio::spawn(async move {
        for value in 1.. {
            let start = Instant::now();
            let result: anyhow::Result<()> = async {
                own.set_param(&key, value).await?;
                let got: i32 = own.get_param(&key).await?.unwrap_or_default();
                anyhow::ensure!(got == value, "got {got}");
                Ok(())
            }
            .await;
            outcome("param", value, start, result);
            tokio::time::sleep(PAUSE).await;
        }
    });
    let (own, server) = (Arc::clone(&node), format!("/ref_{name}/serve"));
    tokio::spawn(async move {
        for number in 1.. {
            let start = Instant::now();
            let result: anyhow::Result<()> = async {
                let client = own.service_client::<Trigger>(&server, false).await?;
                client.call(&TriggerReq {}).await?;
                Ok(())
            }
            .await;
            outcome("call", number, start, result);
            tokio::time::sleep(PAUSE).await;
        }
    });
    let mut number = 0;
    while !node.is_shutdown() {
        number += 1;
        let _ = out.send(&Text {
            data: number.to_string(),
        });
        tokio::time::sleep(TICK).await;
    }
    say("shutdown");
    Ok(())
}
