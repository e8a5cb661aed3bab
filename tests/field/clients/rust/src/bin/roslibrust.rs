//! A node of roslibrust with its feature `ros1`, which has no calls for parameters.

use std::time::Instant;

use foreign_clients::{name, outcome, say, PAUSE, TICK};
use roslibrust::ros1::NodeHandle;

roslibrust::generate_ros_types_with_env!();
use std_srvs::{Trigger, TriggerRequest, TriggerResponse};

#[tokio::main]
async fn main() -> anyhow::Result<()> {
    let name = name();
    let node = NodeHandle::new(&std::env::var("ROS_MASTER_URI")?, &format!("/{name}")).await?;
    let out = node
        .advertise::<std_msgs::String>(&format!("/{name}/out"), 100, false)
        .await?;
    let mut subscriber = node
        .subscribe::<std_msgs::String>(&format!("/ref_{name}/out"), 100)
        .await?;
    let serve = |_: TriggerRequest| {
        Ok(TriggerResponse {
            success: true,
            ..TriggerResponse::default()
        })
    };
    let _service = node
        .advertise_service::<Trigger, _>(&format!("/{name}/serve"), serve)
        .await?;
    say("ready");
    tokio::spawn(async move {
        while let Some(message) = subscriber.next().await {
            match message {
                Ok(text) => say(format_args!("heard {}", text.data)),
                Err(error) => say(format_args!("not heard: {error}")),
            }
        }
    });
    let (own, server) = (node.clone(), format!("/ref_{name}/serve"));
    tokio::spawn(async move {
        for number in 1.. {
            let start = Instant::now();
            let result: anyhow::Result<()> = async {
                let client = own.service_client::<Trigger>(&server).await?;
                client.call(&TriggerRequest {}).await?;
                Ok(())
            }
            .await;
            outcome("call", number, start, result);
            tokio::time::sleep(PAUSE).await;
        }
    });
    let mut number = 0;
    while node.is_ok() {
        number += 1;
        let data = number.to_string();
        let _ = out.publish(&std_msgs::String { data }).await;
        tokio::time::sleep(TICK).await;
    }
    say("shutdown");
    Ok(())
}
