//! Corrects the check sums of a checkpoint file, which a fuzzer could never do by itself.

use super::seal_records::sealed_records;

/// The beginning of a checkpoint's first line.
const MAGIC: &str = "# rosrescue checkpoint v2 ";

/// The file with a first line and records whose check sums are right.
pub(crate) fn sealed(bytes: &[u8]) -> Vec<u8> {
    let Some(end) = bytes.iter().position(|&byte| byte == b'\n') else {
        return bytes.to_vec();
    };
    let (first, rest) = bytes.split_at(end + 1);
    let Some(fields) = std::str::from_utf8(first)
        .ok()
        .and_then(|line| line.strip_prefix(MAGIC))
    else {
        return bytes.to_vec();
    };
    let field = |name| fields.split(' ').find(|field| field.starts_with(name));
    let journal = b"\njournal:\n";
    let length = position(rest, journal).map_or(rest.len(), |at| at + journal.len());
    let (snapshot, records) = rest.split_at(length);
    let mut out = format!(
        "{MAGIC}{} {} snapshot={length} crc32c={:08x} header=",
        field("generation=").unwrap_or("generation=1"),
        field("seq=").unwrap_or("seq=0"),
        crc32c::crc32c(snapshot),
    )
    .into_bytes();
    let stamp = crc32c::crc32c(&out);
    out.extend_from_slice(format!("{stamp:08x}\n").as_bytes());
    out.extend_from_slice(snapshot);
    out.extend_from_slice(&sealed_records(records, stamp));
    out
}

pub(crate) fn position(bytes: &[u8], what: &[u8]) -> Option<usize> {
    bytes.windows(what.len()).position(|window| window == what)
}
