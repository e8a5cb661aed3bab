//! Reads a master's state over a connection.

use rescue_core::replay::{Inspection, NotAMaster, Token};
use ros1_master::master::{Master, Request};
use thiserror::Error;

use super::{CallError, Connection};
use crate::limit::rarely;

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

/// Makes the first of two requests that read a master. Repeats it without the parameters if the master cannot return
/// one of them.
pub(crate) async fn read_first(
    connection: &mut Connection,
    token: &Token,
) -> Result<Inspection, InspectError> {
    let whole = inspect_with(connection, Inspection::call(token), token).await;
    match whole {
        Err(InspectError::NotAMaster(
            NotAMaster::ParamsUnreadable { .. } | NotAMaster::Form { .. },
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
