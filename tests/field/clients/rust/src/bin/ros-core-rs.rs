//! The master of ros-core-rs at the address in `ROS_MASTER_URI`.

use url::Url;

#[tokio::main]
async fn main() -> anyhow::Result<()> {
    let uri = Url::parse(&std::env::var("ROS_MASTER_URI")?)?;
    let address = ros_core_rs::url_to_socket_addr(&uri)?;
    ros_core_rs::core::Master::new(&address).serve().await
}
