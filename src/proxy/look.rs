//! Looks at a master over a connection.

use thiserror::Error;

use super::upstream::{CallError, Connection};
use crate::master::{FirstLook, Mark, Master, NotAMaster};

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
    first: FirstLook,
    connection: &mut Connection,
    previous: &Master,
) -> Result<Master, LookError> {
    let second = match first.second_call(previous) {
        Some(call) => Some(connection.call(&call).await?),
        None => None,
    };
    Ok(first.into_master(second.as_ref(), previous)?)
}
