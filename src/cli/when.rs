//! Times on the command line.

use std::str::FromStr;

/// What to write for a time, for error messages.
const EXAMPLES: &str =
    "write 14:03 or 14:03:05 (UTC, today or yesterday), 2026-11-26T14:03, -5min, -2h, -3d, or now";
const DAY: u64 = 86_400_000;

/// A time on the command line. Clock times are in UTC, like all times that rosrescue prints. Spans are in milliseconds.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum When {
    Now,
    /// This long ago.
    Ago(u64),
    /// The last time that the clock showed this, since midnight.
    OfDay(u64),
    /// Since 1970.
    At(u64),
}

impl When {
    /// The time in milliseconds since 1970, if it is `now`.
    pub fn millis(self, now: u64) -> u64 {
        match self {
            Self::Now => now,
            Self::Ago(span) => now.saturating_sub(span),
            Self::OfDay(of_day) => {
                let today = now - now % DAY + of_day;
                match today > now {
                    true => today.saturating_sub(DAY),
                    false => today,
                }
            }
            Self::At(at) => at,
        }
    }
}

impl FromStr for When {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        let text = text.trim();
        let parsed = match text.strip_prefix('-') {
            _ if text == "now" => Some(Self::Now),
            Some(span) => span_of(span).map(Self::Ago),
            None => parse_time(text),
        };
        parsed.ok_or_else(|| format!("\"{text}\" is not a time: {EXAMPLES}"))
    }
}

fn span_of(text: &str) -> Option<u64> {
    let unit = text.trim_start_matches(|letter: char| letter.is_ascii_digit());
    let count: u64 = text.strip_suffix(unit)?.parse().ok()?;
    let millis = match unit.trim() {
        "s" => 1_000,
        "m" | "min" => 60_000,
        "h" => 3_600_000,
        "d" => DAY,
        _ => return None,
    };
    count.checked_mul(millis)
}

fn parse_time(text: &str) -> Option<When> {
    let text = text.strip_suffix('Z').unwrap_or(text);
    match text.split_once(['T', ' ']) {
        Some((date, time)) => Some(When::At(days_to(date)? * DAY + of_day(time)?)),
        None if text.contains(':') => of_day(text).map(When::OfDay),
        None => Some(When::At(days_to(text)? * DAY)),
    }
}

/// Milliseconds since midnight of a text such as `14:03`, `14:03:05` or `14:03:05.123`.
fn of_day(text: &str) -> Option<u64> {
    let (text, fraction) = text.split_once('.').unwrap_or((text, ""));
    let mut parts = text.split(':').map(number);
    let (hours, minutes) = (parts.next()??, parts.next()??);
    let seconds = parts.next().unwrap_or(Some(0))?;
    let millis = match fraction.is_empty() {
        true => 0,
        false => number(fraction.get(..3).filter(|_| fraction.len() == 3)?)?,
    };
    let valid = hours < 24 && minutes < 60 && seconds < 60 && parts.next().is_none();
    valid.then_some(((hours * 60 + minutes) * 60 + seconds) * 1_000 + millis)
}

/// Days since 1970 of a date such as `2026-11-26`.
fn days_to(date: &str) -> Option<u64> {
    let mut parts = date.split('-').map(number);
    let (year, month, day) = (parts.next()??, parts.next()??, parts.next()??);
    let valid = (1970..10_000).contains(&year)
        && (1..=12).contains(&month)
        && (1..=31).contains(&day)
        && parts.next().is_none();
    if !valid {
        return None;
    }
    // Years from March (Howard Hinnant's "chrono-Compatible Low-Level Date Algorithms").
    let year = if month <= 2 { year - 1 } else { year };
    let of_year = (153 * ((month + 9) % 12) + 2) / 5 + day - 1;
    let (era, of_era) = (year / 400, year % 400);
    let of_era = of_era * 365 + of_era / 4 - of_era / 100 + of_year;
    Some(era * 146_097 + of_era - 719_468)
}

fn number(digits: &str) -> Option<u64> {
    let plain = !digits.is_empty() && digits.bytes().all(|digit| digit.is_ascii_digit());
    plain.then(|| digits.parse().ok()).flatten()
}

#[cfg(test)]
mod tests {
    use super::*;

    /// 2026-11-21T09:26:53Z.
    const NOW: u64 = 1_795_253_213_000;

    #[test]
    fn times_are_read_as_people_write_them() {
        for (text, millis) in [
            ("now", NOW),
            ("-5min", NOW - 300_000),
            ("-2h", NOW - 7_200_000),
            ("-3d", NOW - 3 * DAY),
            ("-90s", NOW - 90_000),
            ("2026-11-21T09:26:53Z", NOW),
            ("2026-11-21 09:26:53", NOW),
            ("2026-11-21T09:26", NOW - 53_000),
            ("2026-11-21T09:26:53.250Z", NOW + 250),
            ("1970-01-01", 0),
            ("2000-02-29", 951_782_400_000),
            ("09:26", NOW - 53_000),
            ("09:27", NOW - DAY + 7_000),
            ("00:00", NOW - NOW % DAY),
        ] {
            let when: When = text.parse().unwrap();
            assert_eq!(when.millis(NOW), millis, "{text}");
        }
        for text in [
            "",
            "14",
            "24:00",
            "1:2:3:4",
            "-5",
            "-5 weeks",
            "2026-13-01",
            "yesterday",
        ] {
            let error = text.parse::<When>().unwrap_err();
            assert!(error.contains("-5min"), "{error}");
        }
    }
}
