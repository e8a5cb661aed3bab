//! Encodes values as YAML, in block style and in flow style.
//!
//! Every string and key is double-quoted on one line. Numbers have a form that YAML 1.1 and 1.2 read alike. Types that
//! YAML lacks are written as `!!pairs`, which no XML-RPC value uses otherwise. serde-saphyr's writer is not used: it
//! has no integers beyond 128 bits, spreads texts over several lines, and takes four times as long for a record (1.1 us
//! instead of 0.25 us).

use std::io::Write;

use super::{DEPTH_MAX, EncodeError};
use ros1_master::xmlrpc::{Struct, Value};

/// Deepest level of structs with one line per member. Deeper ones are written in one line: their indentation would take
/// more space than their content.
const BLOCK_LEVELS_MAX: usize = 32;
/// Longest key, in bytes. YAML 1.1 and 1.2 look for the `:` of an implicit key only within 1,024 characters.
const KEY_BYTES_MAX: usize = 1_000;
/// Maximum number of digits of a decimal integer. CPython refuses to read more (`sys.get_int_max_str_digits`, 4,300).
const INT_DIGITS_MAX: usize = 4_000;
/// The kind of `!!pairs` entry that holds a date.
pub(super) const DATE_TIME: &str = "dateTime.iso8601";
/// The kind of `!!pairs` entry that holds a large integer.
pub(super) const BIG_INT: &str = "int";
pub(super) const BIG_DECIMAL: &str = "bigdecimal";

/// Writes `members` in block style, one line each, indented by `indent` columns.
pub(super) fn block(
    out: &mut Vec<u8>,
    members: &Struct,
    indent: usize,
    depth: usize,
) -> Result<(), EncodeError> {
    for (name, value) in members {
        block_key(out, name, indent);
        match value {
            Value::Struct(inner) if !inner.is_empty() && depth < BLOCK_LEVELS_MAX => {
                out.push(b'\n');
                block(out, inner, indent + 2, depth + 1)?;
            }
            other => {
                out.push(b' ');
                flow(out, other, depth)?;
                out.push(b'\n');
            }
        }
    }
    Ok(())
}

/// Writes `name` and its colon at the start of a line.
pub(super) fn block_key(out: &mut Vec<u8>, name: &str, indent: usize) {
    spaces(out, indent);
    let start = out.len();
    quoted(out, name);
    if out.len() - start > KEY_BYTES_MAX {
        out.splice(start..start, *b"? ");
        out.push(b'\n');
        spaces(out, indent);
    }
    out.push(b':');
}

fn spaces(out: &mut Vec<u8>, count: usize) {
    out.resize(out.len() + count, b' ');
}

/// Writes `value` without a line break.
pub(super) fn flow(out: &mut Vec<u8>, value: &Value, depth: usize) -> Result<(), EncodeError> {
    match value {
        Value::Nil => out.extend_from_slice(b"null"),
        Value::Bool(true) => out.extend_from_slice(b"true"),
        Value::Bool(false) => out.extend_from_slice(b"false"),
        Value::Int(number) => decimal(out, i64::from(*number)),
        Value::BigInt(digits) if is_plain_big_int(digits) => {
            out.extend_from_slice(digits.as_bytes());
        }
        Value::BigInt(digits) => pair(out, BIG_INT, digits),
        Value::BigDecimal(text) => pair(out, BIG_DECIMAL, text),
        Value::Double(number) => double(out, *number),
        Value::String(text) => quoted(out, text),
        Value::DateTime(text) => match timestamp(text) {
            Some(stamp) => {
                out.extend_from_slice(b"!!timestamp \"");
                out.extend_from_slice(stamp.as_bytes());
                out.push(b'"');
            }
            None => pair(out, DATE_TIME, text),
        },
        Value::Base64(bytes) => {
            use base64::Engine as _;
            out.extend_from_slice(b"!!binary \"");
            out.extend_from_slice(
                base64::engine::general_purpose::STANDARD
                    .encode(bytes)
                    .as_bytes(),
            );
            out.push(b'"');
        }
        Value::Array(elements) => {
            deeper(depth)?;
            flow_list(out, elements, |out, element| flow(out, element, depth + 1))?;
        }
        Value::Struct(members) => {
            deeper(depth)?;
            out.push(b'{');
            for (nth, (name, value)) in members.iter().enumerate() {
                if nth > 0 {
                    out.extend_from_slice(b", ");
                }
                let start = out.len();
                quoted(out, name);
                if out.len() - start > KEY_BYTES_MAX {
                    out.splice(start..start, *b"? ");
                    out.push(b' ');
                }
                out.extend_from_slice(b": ");
                flow(out, value, depth + 1)?;
            }
            out.push(b'}');
        }
    }
    Ok(())
}

fn deeper(depth: usize) -> Result<(), EncodeError> {
    if depth < DEPTH_MAX {
        Ok(())
    } else {
        Err(EncodeError::TooDeep { limit: DEPTH_MAX })
    }
}

/// Writes `[a, b]`.
pub(super) fn flow_list<T>(
    out: &mut Vec<u8>,
    items: &[T],
    mut write: impl FnMut(&mut Vec<u8>, &T) -> Result<(), EncodeError>,
) -> Result<(), EncodeError> {
    out.push(b'[');
    for (nth, item) in items.iter().enumerate() {
        if nth > 0 {
            out.extend_from_slice(b", ");
        }
        write(out, item)?;
    }
    out.push(b']');
    Ok(())
}

/// Writes a value of a type that YAML lacks.
fn pair(out: &mut Vec<u8>, kind: &str, text: &str) {
    out.extend_from_slice(b"!!pairs [{");
    quoted(out, kind);
    out.extend_from_slice(b": ");
    quoted(out, text);
    out.extend_from_slice(b"}]");
}

/// Writes a decimal number.
pub(super) fn decimal(out: &mut Vec<u8>, number: impl std::fmt::Display) {
    // Writing to a vector cannot fail.
    let _ = write!(out, "{number}");
}

/// Whether a YAML reader reads `digits` without quotes back as the same [`Value::BigInt`].
fn is_plain_big_int(digits: &str) -> bool {
    let magnitude = digits.strip_prefix('-').unwrap_or(digits);
    (10..=INT_DIGITS_MAX).contains(&magnitude.len())
        && magnitude.bytes().all(|byte| byte.is_ascii_digit())
        && !magnitude.starts_with('0')
        && digits.parse::<i32>().is_err()
}

/// Writes a double with the fewest digits that are read back as the same bits. YAML 1.1 requires a point in every float
/// and a sign in every exponent. Every NaN is written as `.nan`, because XML-RPC has only one `nan`.
fn double(out: &mut Vec<u8>, number: f64) {
    if number.is_nan() {
        return out.extend_from_slice(b".nan");
    }
    if number.is_infinite() {
        return out.extend_from_slice(if number > 0.0 { b".inf" } else { b"-.inf" });
    }
    let start = out.len();
    let _ = write!(out, "{number:?}");
    let Some(exponent) = out.iter().skip(start).position(|&byte| byte == b'e') else {
        return;
    };
    let exponent = start + exponent;
    if out.get(exponent + 1) != Some(&b'-') {
        out.insert(exponent + 1, b'+');
    }
    if !out.iter().skip(start).any(|&byte| byte == b'.') {
        out.splice(exponent..exponent, *b".0");
    }
}

/// Converts `20240131T12:00:00`, as Python writes a date, to a YAML timestamp. `None` for any other text.
pub(super) fn timestamp(text: &str) -> Option<String> {
    let number = |range: std::ops::Range<usize>| {
        let digits = text.get(range)?;
        digits
            .bytes()
            .all(|byte| byte.is_ascii_digit())
            .then(|| digits.parse::<u32>().ok())?
    };
    let (year, month, day) = (number(0..4)?, number(4..6)?, number(6..8)?);
    let (hour, minute, second) = (number(9..11)?, number(12..14)?, number(15..17)?);
    let leap = year % 4 == 0 && (year % 100 != 0 || year % 400 == 0);
    let days = match month {
        1 | 3 | 5 | 7 | 8 | 10 | 12 => 31,
        4 | 6 | 9 | 11 => 30,
        2 if leap => 29,
        2 => 28,
        _ => return None,
    };
    let real = year > 0 && (1..=days).contains(&day) && hour < 24 && minute < 60 && second < 60;
    let spelled = format!("{year:04}-{month:02}-{day:02}T{hour:02}:{minute:02}:{second:02}");
    (real && date_time(&spelled).as_deref() == Some(text)).then_some(spelled)
}

/// Reverses [`timestamp`].
pub(super) fn date_time(stamp: &str) -> Option<String> {
    let (date, time) = stamp.split_once('T')?;
    Some(format!("{}T{time}", date.replace('-', "")))
}

/// Writes `text` in double quotes on one line, so that every YAML reader reads it back exactly.
pub(super) fn quoted(out: &mut Vec<u8>, text: &str) {
    out.push(b'"');
    let plain = text
        .bytes()
        .position(|byte| !is_plain(byte))
        .unwrap_or(text.len());
    let (head, rest) = text.split_at(plain);
    out.extend_from_slice(head.as_bytes());
    for character in rest.chars() {
        let code = u32::from(character);
        let _ = match character {
            '"' => out.write_all(b"\\\""),
            '\\' => out.write_all(b"\\\\"),
            '\n' => out.write_all(b"\\n"),
            '\r' => out.write_all(b"\\r"),
            '\t' => out.write_all(b"\\t"),
            ' '..='~' => out.write_all(&[code as u8]),
            _ if is_shown(character) => {
                out.write_all(character.encode_utf8(&mut [0; 4]).as_bytes())
            }
            _ if code <= 0xff => write!(out, "\\x{code:02x}"),
            _ if code <= 0xffff => write!(out, "\\u{code:04x}"),
            _ => write!(out, "\\U{code:08x}"),
        };
    }
    out.push(b'"');
}

/// Whether a byte needs no escape in a double-quoted scalar.
fn is_plain(byte: u8) -> bool {
    matches!(byte, b' '..=b'~') && byte != b'"' && byte != b'\\'
}

/// Whether a non-ASCII character is written unescaped. It is escaped if PyYAML refuses it, if YAML 1.1 breaks lines at
/// it, or if it is invisible.
fn is_shown(character: char) -> bool {
    !matches!(character,
        '\u{0}'..='\u{a0}' | '\u{ad}' | '\u{200b}'..='\u{200f}' | '\u{2028}'..='\u{202e}'
        | '\u{2060}'..='\u{206f}' | '\u{fdd0}'..='\u{fdef}' | '\u{feff}' | '\u{fff0}'..='\u{ffff}')
        && u32::from(character) & 0xfffe != 0xfffe
}
