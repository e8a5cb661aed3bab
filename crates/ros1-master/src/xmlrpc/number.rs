//! Reads and writes numbers and binary data as Python does.

use std::borrow::Cow;

use super::value::Value;

/// Maximum number of digits that Python's `int()` accepts in text, including leading zeros
/// (`sys.int_info.default_max_str_digits`, since Python 3.11.0).
const MAX_DIGITS: usize = 4300;

/// The white space that Python strips from a number, as far as ASCII and XML have it.
const SPACE: [char; 4] = [' ', '\t', '\n', '\r'];

/// Decimal digits outside of ASCII: the zero of each script in the first plane that Python 2.7 knows, and so every later
/// Python. The other nine follow it.
const ZEROS: &[char] = &[
    '\u{660}', '\u{6f0}', '\u{7c0}', '\u{966}', '\u{9e6}', '\u{a66}', '\u{ae6}', '\u{b66}',
    '\u{be6}', '\u{c66}', '\u{ce6}', '\u{d66}', '\u{e50}', '\u{ed0}', '\u{f20}', '\u{1040}',
    '\u{1090}', '\u{17e0}', '\u{1810}', '\u{1946}', '\u{19d0}', '\u{1a80}', '\u{1a90}', '\u{1b50}',
    '\u{1bb0}', '\u{1c40}', '\u{1c50}', '\u{a620}', '\u{a8d0}', '\u{a900}', '\u{a9d0}', '\u{aa50}',
    '\u{abf0}', '\u{ff10}',
];

/// `text` with ASCII digits in place of the digits of other scripts, as Python reads numbers. `None` if another
/// character is not ASCII.
pub(super) fn ascii_digits(text: &str) -> Option<Cow<'_, str>> {
    if text.is_ascii() {
        return Some(Cow::Borrowed(text));
    }
    let digit = |character: char| {
        let zero = ZEROS.iter().rev().find(|&&zero| zero <= character)?;
        char::from_digit(u32::from(character) - u32::from(*zero), 10)
    };
    let ascii = |character: char| match character.is_ascii() {
        true => Some(character),
        false => digit(character),
    };
    text.chars().map(ascii).collect()
}

/// Python's `int(text)`, for ASCII text.
pub(super) fn int(text: &str) -> Option<Value> {
    if text.len() <= MAX_DIGITS
        && let Ok(number) = text.parse()
    {
        return Some(Value::Int(number));
    }
    let text = text.trim_matches(SPACE);
    let (negative, digits) = match text.strip_prefix('-') {
        Some(digits) => (true, digits),
        None => (false, text.strip_prefix('+').unwrap_or(text)),
    };
    let digits = without_underscores(digits)?;
    if digits.is_empty() || digits.len() > MAX_DIGITS || !digits.bytes().all(|b| b.is_ascii_digit())
    {
        return None;
    }
    let digits = digits.trim_start_matches('0');
    let canonical = match (negative, digits.is_empty()) {
        (_, true) => return Some(Value::Int(0)),
        (true, _) => format!("-{digits}"),
        (false, _) => digits.to_owned(),
    };
    Some(match canonical.parse() {
        Ok(number) => Value::Int(number),
        Err(_) => Value::BigInt(canonical),
    })
}

/// Python's `float(text)`, for ASCII text. Every NaN becomes [`f64::NAN`], because Python's text of a NaN shows neither
/// its sign nor its payload.
pub(super) fn float(text: &str) -> Option<f64> {
    // Rust accepts exactly what Python accepts, except for white space and underscores.
    let number: f64 = match text.parse() {
        Ok(number) => number,
        Err(_) => without_underscores(text.trim_matches(SPACE))?
            .parse()
            .ok()?,
    };
    Some(if number.is_nan() { f64::NAN } else { number })
}

/// Whether `text` is a decimal number of digits, at most one point, and a sign. Python's `Decimal` accepts more.
pub(super) fn is_plain_decimal(text: &str) -> bool {
    let number = text.strip_prefix(['-', '+']).unwrap_or(text);
    let (whole, fraction) = number.split_once('.').unwrap_or((number, ""));
    let digits = [whole, fraction].concat();
    !digits.is_empty() && digits.bytes().all(|byte| byte.is_ascii_digit())
}

/// `text` without its underscores. `None` if one of them is not between two digits.
fn without_underscores(text: &str) -> Option<String> {
    let mut plain = String::with_capacity(text.len());
    let mut parts = text.split('_').peekable();
    let mut first = true;
    while let Some(part) = parts.next() {
        let starts = first || part.starts_with(|c: char| c.is_ascii_digit());
        let ends = parts.peek().is_none() || part.ends_with(|c: char| c.is_ascii_digit());
        if !starts || !ends {
            return None;
        }
        first = false;
        plain.push_str(part);
    }
    Some(plain)
}

/// Python's `repr(number)`: the fewest digits that identify the number, with an exponent below 1e-4 and from
/// 1e16 up.
pub(super) fn repr(number: f64) -> String {
    if number.is_nan() {
        return "nan".to_owned();
    }
    if number.is_infinite() {
        return if number > 0.0 { "inf" } else { "-inf" }.to_owned();
    }
    let shortest = shortest(number);
    let Some((mantissa, exponent)) = shortest.split_once('e') else {
        return shortest;
    };
    let exponent: i32 = exponent.parse().unwrap_or_default();
    if !(-4..16).contains(&exponent) {
        let sign = if exponent < 0 { '-' } else { '+' };
        return format!("{mantissa}e{sign}{:02}", exponent.unsigned_abs());
    }
    let (sign, mantissa) = match mantissa.strip_prefix('-') {
        Some(mantissa) => ("-", mantissa),
        None => ("", mantissa),
    };
    let mut digits = mantissa.replace('.', "");
    let Ok(whole) = usize::try_from(exponent) else {
        let zeros = exponent.unsigned_abs() as usize - 1;
        return format!("{sign}0.{:0<zeros$}{digits}", "");
    };
    while digits.len() < whole + 2 {
        digits.push('0');
    }
    digits.insert(whole + 1, '.');
    format!("{sign}{digits}")
}

/// The text with the fewest digits that identify the number, such as `d.ddde-7`.
///
/// If two texts of this length are equally near to the number, Rust takes the upper one, and Python the one with an
/// even last digit: -823967287502993.25 is `…993.3` in Rust and `…993.2` in Python. Rounding the number to as many
/// digits gives Python's text.
fn shortest(number: f64) -> String {
    let shortest = format!("{number:e}");
    let mantissa = shortest.split('e').next().unwrap_or_default();
    let digits = mantissa.bytes().filter(u8::is_ascii_digit).count();
    // Below 1e-307 two texts of up to 15 digits can identify the same number. But numbers there have far too many
    // digits to be exactly between the two.
    if digits <= 15 {
        return shortest;
    }
    let rounded = format!("{number:.*e}", digits - 1);
    if rounded.parse() == Ok(number) {
        rounded
    } else {
        shortest
    }
}

/// Python's `binascii.a2b_base64(text)`, as lenient as `base64.decodebytes`: it skips characters outside the
/// alphabet and ignores everything after complete padding.
pub(super) fn base64_bytes(text: &str) -> Option<Vec<u8>> {
    let mut bytes = Vec::with_capacity(text.len() / 4 * 3);
    let mut place = 0_u8;
    let mut pads = 0;
    let mut left = 0_u8;
    for byte in text.bytes() {
        let bits = match byte {
            b'A'..=b'Z' => byte - b'A',
            b'a'..=b'z' => byte - b'a' + 26,
            b'0'..=b'9' => byte - b'0' + 52,
            b'+' => 62,
            b'/' => 63,
            b'=' if place >= 2 => {
                pads += 1;
                if place + pads >= 4 {
                    return Some(bytes);
                }
                continue;
            }
            _ => continue,
        };
        pads = 0;
        match place {
            0 => left = bits,
            1 => {
                bytes.push(left << 2 | bits >> 4);
                left = bits & 0x0f;
            }
            2 => {
                bytes.push(left << 4 | bits >> 2);
                left = bits & 0x03;
            }
            _ => bytes.push(left << 6 | bits),
        }
        place = (place + 1) % 4;
    }
    (place == 0).then_some(bytes)
}
