//! Looks at a master over a connection.

use thiserror::Error;

use super::upstream::{CallError, Connection};
use crate::master::{FirstLook, Master, NotAMaster, Salvage, Token};
use crate::xmlrpc::Call;

/// A look that showed nothing.
#[derive(Debug, Error)]
#[non_exhaustive]
pub enum LookError {
    /// The connection failed.
    #[error(transparent)]
    Call(#[from] CallError),
    /// What answers is no master.
    #[error(transparent)]
    NotAMaster(#[from] NotAMaster),
}

/// The first look; without the parameters if the master cannot return one of them.
pub async fn first(connection: &mut Connection, token: &Token) -> Result<FirstLook, LookError> {
    let whole = look(connection, &FirstLook::call(token)).await;
    match whole {
        Err(LookError::NotAMaster(
            NotAMaster::ParamsUnreadable { .. } | NotAMaster::Form { .. },
        )) => look(connection, &FirstLook::call_without_params(token)).await,
        Err(error) if is_broken_document(&error) => {
            let rest = look(connection, &FirstLook::call_without_params(token)).await;
            // Whoever speaks no XML-RPC at all may have closed the connection.
            rest.map_err(|_| error)
        }
        whole => whole,
    }
}

async fn look(connection: &mut Connection, call: &Call) -> Result<FirstLook, LookError> {
    Ok(FirstLook::decode(&connection.call(call).await?)?)
}

/// Whether a parameter may have broken the document: a master does not escape a date's text.
fn is_broken_document(error: &LookError) -> bool {
    matches!(error, LookError::Call(CallError::NotXmlRpc { status, .. }) if status.is_success())
}

/// The second look, and with it the state that the master holds.
pub async fn second(
    mut first: FirstLook,
    connection: &mut Connection,
    previous: &Master,
) -> Result<Master, LookError> {
    if !first.has_params() {
        first = salvage(first, connection, previous).await?;
    }
    let second = match first.second_call(previous) {
        Some(call) => Some(connection.call(&call).await?),
        None => None,
    };
    Ok(first.into_master(second.as_ref(), previous)?)
}

/// The look with the parameters of a master that holds one that it cannot return: each that can be
/// read, and the others as they were.
async fn salvage(
    first: FirstLook,
    connection: &mut Connection,
    previous: &Master,
) -> Result<FirstLook, LookError> {
    let names = connection.call(&Salvage::names()).await?;
    let Some(mut salvage) = Salvage::new(&names, previous.params()) else {
        return Ok(first);
    };
    while let Some(call) = salvage.question() {
        match connection.call(&call).await.map_err(LookError::from) {
            Ok(reply) => salvage.take(Some(&reply)),
            Err(error) if is_broken_document(&error) => salvage.take(None),
            Err(error) => return Err(error),
        }
    }
    let (params, unreadable) = salvage.finish();
    if !unreadable.is_empty() {
        tracing::warn!(
            ?unreadable,
            "the master holds parameters that it can never return; they are not protected, and neither \
         they nor the namespaces around them can be read by anybody. Delete them, or set them to \
         numbers of 32 bits and dates without markup"
        );
    }
    Ok(first.with_params(params))
}
