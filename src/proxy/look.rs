//! Looks at a master over a connection.

use thiserror::Error;

use super::upstream::{CallError, Connection};
use crate::master::{FirstLook, Mark, Master, NotAMaster, Salvage};

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
pub async fn first(connection: &mut Connection, mark: &Mark) -> Result<FirstLook, LookError> {
    match FirstLook::decode(&connection.call(&FirstLook::call(mark)).await?) {
        Err(NotAMaster::ParamsUnreadable { .. }) => {
            let call = FirstLook::call_without_params(mark);
            Ok(FirstLook::decode(&connection.call(&call).await?)?)
        }
        look => Ok(look?),
    }
}

/// The second look, and with it the state that the master holds.
pub async fn second(
    mut first: FirstLook,
    connection: &mut Connection,
    previous: &Master,
) -> Result<Master, LookError> {
    // What we know of the parameters is better than what can be read; if we know nothing, not.
    if !first.has_params() && previous.params().is_empty() {
        first = salvage(first, connection).await?;
    }
    let second = match first.second_call(previous) {
        Some(call) => Some(connection.call(&call).await?),
        None => None,
    };
    Ok(first.into_master(second.as_ref(), previous)?)
}

/// The look with what can be read of the parameters of a master that holds one that it cannot return.
async fn salvage(first: FirstLook, connection: &mut Connection) -> Result<FirstLook, LookError> {
    let Some(mut salvage) = Salvage::new(&connection.call(&Salvage::names()).await?) else {
        return Ok(first);
    };
    while let Some(call) = salvage.next() {
        salvage.take(&connection.call(&call).await?);
    }
    let (params, unreadable) = salvage.finish();
    tracing::warn!(
        ?unreadable,
        "the master holds parameters that it can never return; they are not protected, and neither \
         they nor the namespaces around them can be read by anybody. Delete them, or set them to \
         what fits 32 bits"
    );
    Ok(first.with_params(params))
}
