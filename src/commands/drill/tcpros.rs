//! The part of TCPROS that a subscriber needs if it does not decode messages.

use std::io;

use tokio::{
    io::{AsyncReadExt, AsyncWriteExt},
    net::TcpStream,
};

/// Largest header that is read, in bytes.
const MAX_HEADER: u32 = 1 << 20;

/// A connection to a publisher.
#[derive(Debug)]
pub(super) struct Link {
    stream: TcpStream,
    /// Whether messages begin with a `std_msgs/Header`, whose first field is a sequence number.
    is_numbered: bool,
}

impl Link {
    /// Connects the subscriber `caller` to the publisher of `topic` at `address`.
    pub(super) async fn connect(
        (host, port): (&str, u16),
        caller: &str,
        topic: &str,
    ) -> Result<Self, String> {
        let connect = async {
            let addresses = crate::resolver::addresses(host, port).await?;
            let mut stream = TcpStream::connect(&*addresses).await?;
            stream.write_all(&header(caller, topic)).await?;
            let length = stream.read_u32_le().await?;
            if length > MAX_HEADER {
                return Err(io::Error::other("it speaks another protocol"));
            }
            let mut answer = vec![0; usize::try_from(length).unwrap_or_default()];
            stream.read_exact(&mut answer).await?;
            io::Result::Ok((stream, answer))
        };
        let (stream, answer) = connect.await.map_err(|error| error.to_string())?;
        match fields(&answer).find(|(name, _)| name == "error") {
            Some((_, why)) => Err(why),
            None => Ok(Self {
                stream,
                is_numbered: fields(&answer)
                    .any(|(name, text)| name == "message_definition" && begins_with_header(&text)),
            }),
        }
    }

    /// Waits for the next message, and returns its sequence number if it has one.
    pub(super) async fn next_message(&mut self) -> io::Result<Option<u32>> {
        let mut length = u64::from(self.stream.read_u32_le().await?);
        let mut number = None;
        if self.is_numbered && length >= 4 {
            number = Some(self.stream.read_u32_le().await?);
            length -= 4;
        }
        let mut rest = (&mut self.stream).take(length);
        let read = tokio::io::copy(&mut rest, &mut tokio::io::sink()).await?;
        match read == length {
            true => Ok(number),
            false => Err(io::ErrorKind::UnexpectedEof.into()),
        }
    }
}

/// The header of a subscriber to any type, as `rostopic hz` sends it.
fn header(caller: &str, topic: &str) -> Vec<u8> {
    let mut header = Vec::new();
    for (name, value) in [
        ("callerid", caller),
        ("topic", topic),
        ("type", "*"),
        ("md5sum", "*"),
        ("message_definition", ""),
        ("tcp_nodelay", "1"),
    ] {
        let field = format!("{name}={value}");
        header.extend(length(field.len()));
        header.extend(field.into_bytes());
    }
    [&length(header.len())[..], &header].concat()
}

fn length(of: usize) -> [u8; 4] {
    u32::try_from(of).unwrap_or(u32::MAX).to_le_bytes()
}

/// Names and values in a header without its length. Stops at the first malformed field.
fn fields(mut header: &[u8]) -> impl Iterator<Item = (String, String)> {
    std::iter::from_fn(move || {
        let (length, rest) = header.split_first_chunk()?;
        let length = usize::try_from(u32::from_le_bytes(*length)).ok()?;
        let (field, rest) = rest.split_at_checked(length)?;
        header = rest;
        let field = String::from_utf8_lossy(field);
        let (name, value) = field.split_once('=')?;
        Some((name.to_owned(), value.to_owned()))
    })
}

/// Whether the first field of a message's definition is a header.
fn begins_with_header(definition: &str) -> bool {
    let lines = definition.lines().map(|line| {
        let code = line.split('#').next().unwrap_or_default();
        code.trim()
    });
    let mut fields = lines.filter(|code| !code.is_empty() && !code.contains('='));
    let first = fields.next().and_then(|field| field.split(' ').next());
    first.is_some_and(|of| of == "Header" || of == "std_msgs/Header")
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_header_is_read_as_it_is_written() {
        let written = header("/drill", "/chatter");
        let (length, rest) = written.split_first_chunk().unwrap();
        assert_eq!(u32::from_le_bytes(*length) as usize, rest.len());
        let found: Vec<_> = fields(rest).collect();
        assert!(found.contains(&("callerid".to_owned(), "/drill".to_owned())));
        assert!(found.contains(&("md5sum".to_owned(), "*".to_owned())));
        for cut in 0..rest.len() {
            assert!(fields(&rest[..cut]).count() < found.len());
        }
    }

    #[test]
    fn messages_that_begin_with_a_header_are_numbered() {
        for (definition, numbered) in [
            ("Header header\nfloat64 x", true),
            ("# A scan\n\nstd_msgs/Header header # of it\n", true),
            ("uint8 ONE=1\nHeader h", true),
            ("string data\n", false),
            (
                "geometry_msgs/TransformStamped[] transforms\n===\nMSG: x\nHeader header",
                false,
            ),
            ("", false),
        ] {
            assert_eq!(begins_with_header(definition), numbered, "{definition}");
        }
    }
}
