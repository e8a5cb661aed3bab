//! Corrects the check sums of records.

/// The beginning of a record's line.
const RECORD_START: &[u8] = b"- {seq: ";

/// The records of a file with this `stamp`, 0 outside of any file, with right check sums.
pub(crate) fn sealed_records(records: &[u8], stamp: u32) -> Vec<u8> {
    let mut out = Vec::new();
    for line in records.split_inclusive(|&byte| byte == b'\n') {
        let body = line.windows(2).rposition(|window| window == b" #");
        match body.and_then(|end| line.get(..end)) {
            Some(body) if line.starts_with(RECORD_START) && line.ends_with(b"\n") => {
                let start = out.len();
                out.extend_from_slice(body);
                out.extend_from_slice(format!(" #{stamp:08x}").as_bytes());
                let check = crc32c::crc32c(&out[start..]);
                out.extend_from_slice(format!(" {check:08x}\n").as_bytes());
            }
            _ => out.extend_from_slice(line),
        }
    }
    out
}
