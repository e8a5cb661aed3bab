//! Reads a master's state over a connection.

use std::time::Duration;

use rescue_core::replay::{Inspection, NotAMaster, Token};
use ros1_master::master::{Master, Request};
use thiserror::Error;
use tokio::time::sleep;

use super::{CallError, Connection};
use crate::limit::rarely;

/// How often to read a master while other programs change its parameters.
const READS: u32 = 5;
/// Pause between two such reads.
const READ_PAUSE: Duration = Duration::from_millis(20);

/// Why a master's state could not be read.
#[derive(Debug, Error)]
#[non_exhaustive]
pub(crate) enum InspectError {
    #[error(transparent)]
    Call(#[from] CallError),
    /// The server is not a master.
    #[error(transparent)]
    NotAMaster(#[from] NotAMaster),
}

/// Makes the first of two requests that read a master. Repeats it if another program changes parameters at the same
/// time. Repeats it without the parameters if the master cannot return one of them, or if they change all the time.
pub(crate) async fn read_first(
    connection: &mut Connection,
    token: &Token,
) -> Result<Inspection, InspectError> {
    let mut whole = inspect_with(connection, Inspection::call(token), token).await;
    for _ in 1..READS {
        if !are_changing(&whole) {
            break;
        }
        sleep(READ_PAUSE).await;
        whole = inspect_with(connection, Inspection::call(token), token).await;
    }
    match whole {
        Err(InspectError::NotAMaster(
            NotAMaster::ParamsUnreadable { .. }
            | NotAMaster::ParamsChanging { .. }
            | NotAMaster::Form { .. },
        )) => inspect_with(connection, Inspection::call_without_params(token), token).await,
        Err(error) if is_broken_document(&error) => {
            let rest =
                inspect_with(connection, Inspection::call_without_params(token), token).await;
            // A server that does not speak XML-RPC may have closed the connection.
            rest.map_err(|_| error)
        }
        whole => whole,
    }
}

/// Whether another program changed parameters while the master encoded them.
fn are_changing(whole: &Result<Inspection, InspectError>) -> bool {
    matches!(
        whole,
        Err(InspectError::NotAMaster(NotAMaster::ParamsChanging { .. }))
    )
}

async fn inspect_with(
    connection: &mut Connection,
    call: Request,
    token: &Token,
) -> Result<Inspection, InspectError> {
    let reply = connection.call(&call).await?;
    Ok(Inspection::decode(&reply, token)?)
}

/// Whether a parameter may have made the reply invalid XML: a master does not escape the text of a date.
fn is_broken_document(error: &InspectError) -> bool {
    matches!(error, InspectError::Call(CallError::NotXmlRpc { status, .. }) if status.is_success())
}

/// Makes the second request, and returns the master's state.
pub(crate) async fn read_second(
    first: Inspection,
    connection: &mut Connection,
    previous: &Master,
) -> Result<Master, InspectError> {
    if !first.has_params() {
        rarely!(
            warn,
            "the master holds a parameter that it can never return; getParam fails for it and for every namespace that contains it. Delete it, or set a value without nil, without integers beyond 32 bits, and without `<` or `&` in dates"
        );
    }
    let second = match first.second_call(previous) {
        Some(call) => Some(connection.call(&call).await?),
        None => None,
    };
    Ok(tokio::task::block_in_place(|| {
        first.into_master(second.as_ref(), previous)
    })?)
}

#[cfg(test)]
mod tests {
    use ros1_master::xmlrpc::{self, Reply};
    use tokio::{
        io::{AsyncReadExt, AsyncWriteExt},
        net::TcpListener,
    };

    use super::*;
    use crate::{ros_env::MasterUri, upstream::Upstream};

    /// What is read from a master whose parameters another program changes during the first `changes` reads.
    async fn read_during(changes: usize) -> Inspection {
        let listener = TcpListener::bind("127.0.0.1:0").await.unwrap();
        let uri = format!("http://{}/", listener.local_addr().unwrap());
        let upstream = Upstream::new(MasterUri::parse(&uri).unwrap(), Duration::from_secs(1), 3);
        let serve = async {
            let (mut stream, _) = listener.accept().await.unwrap();
            let mut master = Master::default();
            let mut reads = 0;
            loop {
                let mut request = Vec::new();
                while !request.trim_ascii_end().ends_with(b"</methodCall>") {
                    assert_ne!(stream.read_buf(&mut request).await.unwrap(), 0);
                }
                let text = String::from_utf8(request).unwrap();
                let (_, body) = text.split_once("\r\n\r\n").unwrap();
                reads += usize::from(body.contains("getParam"));
                let reply = match body.contains("getParam") && reads <= changes {
                    true => Reply::Fault {
                        code: 1,
                        text: "<class 'RuntimeError'>:dictionary changed size during iteration"
                            .to_owned(),
                    },
                    false => {
                        master
                            .apply(&Request::decode(body.as_bytes()).unwrap())
                            .reply
                    }
                };
                let body = xmlrpc::encode_reply(&reply);
                let head = format!("HTTP/1.1 200 OK\r\nContent-Length: {}\r\n\r\n", body.len());
                stream.write_all(head.as_bytes()).await.unwrap();
                stream.write_all(&body).await.unwrap();
            }
        };
        let read = async {
            let mut connection = upstream.connect().await.unwrap();
            read_first(&mut connection, &Token::new("m", 1)).await
        };
        tokio::select! {
            found = read => found.unwrap(),
            () = serve => unreachable!("the server goes on"),
        }
    }

    #[tokio::test]
    async fn a_master_whose_parameters_change_meanwhile_is_read_again() {
        for changes in [0, 1, READS as usize - 1] {
            assert!(read_during(changes).await.has_params(), "{changes}");
        }
        // The rest of the state counts, even if the parameters never stop changing.
        assert!(!read_during(usize::MAX).await.has_params());
    }
}
