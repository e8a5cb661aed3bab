//! The wall clock, for display only. No decision may depend on it: robots start without a
//! battery-backed clock, and the clock jumps by years when the network comes up.

use std::time::{Duration, Instant, SystemTime, UNIX_EPOCH};

/// The present wall time in seconds since 1970, to the microsecond; 0 if the clock shows an earlier time.
#[allow(
    clippy::disallowed_methods,
    reason = "the one place that reads the wall clock"
)]
pub fn wall_time() -> f64 {
    SystemTime::now()
        .duration_since(UNIX_EPOCH)
        .map_or(0.0, |since| since.as_secs_f64())
}

/// The present wall time in milliseconds since 1970; 0 if the clock shows an earlier time.
pub fn wall_millis() -> u64 {
    (wall_time() * 1e3) as u64
}

/// Wall time at `moment`, computed from what the clock shows now.
pub fn wall_time_of(moment: Instant) -> f64 {
    (wall_time() - moment.elapsed().as_secs_f64()).max(0.0)
}

/// The moment of a wall time, computed from what the clock shows now. A time in the future gives the present.
pub fn moment_of(seconds: f64) -> Instant {
    let now = Instant::now();
    let since = Duration::try_from_secs_f64(wall_time() - seconds).unwrap_or_default();
    now.checked_sub(since).unwrap_or(now)
}

/// Formats a wall time in UTC, as in `2026-11-21T09:26:53Z`.
pub fn wall_text(seconds: f64) -> String {
    let seconds = seconds.max(0.0) as i64;
    let (days, time) = (seconds.div_euclid(86_400), seconds.rem_euclid(86_400));
    // Days to a date of the Gregorian calendar, counting years from March (Howard Hinnant's
    // "chrono-Compatible Low-Level Date Algorithms").
    let z = days + 719_468;
    let era = z.div_euclid(146_097);
    let of_era = z.rem_euclid(146_097);
    let year_of_era = (of_era - of_era / 1_460 + of_era / 36_524 - of_era / 146_096) / 365;
    let of_year = of_era - (365 * year_of_era + year_of_era / 4 - year_of_era / 100);
    let shifted = (5 * of_year + 2) / 153;
    let day = of_year - (153 * shifted + 2) / 5 + 1;
    let month = if shifted < 10 {
        shifted + 3
    } else {
        shifted - 9
    };
    let year = year_of_era + era * 400 + i64::from(month <= 2);
    let (hour, minute, second) = (time / 3_600, time / 60 % 60, time % 60);
    format!("{year:04}-{month:02}-{day:02}T{hour:02}:{minute:02}:{second:02}Z")
}

/// Formats a wall time in milliseconds since 1970 in UTC, as in `2026-11-21T09:26:53.123Z`.
pub fn wall_text_millis(millis: u64) -> String {
    let text = wall_text((millis / 1_000) as f64);
    format!("{}.{:03}Z", text.trim_end_matches('Z'), millis % 1_000)
}

/// Formats a time span for people, as in `2 h 5 min`.
pub fn span(seconds: f64) -> String {
    let whole = seconds.max(0.0) as u64;
    let (days, hours, minutes) = (whole / 86_400, whole / 3_600 % 24, whole / 60 % 60);
    match (days, hours, minutes) {
        (0, 0, 0) if whole < 10 => format!("{:.1} s", seconds.max(0.0)),
        (0, 0, 0) => format!("{whole} s"),
        (0, 0, _) => format!("{minutes} min {} s", whole % 60),
        (0, ..) => format!("{hours} h {minutes} min"),
        _ => format!("{days} d {hours} h"),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn dates() {
        for (seconds, text) in [
            (0.0, "1970-01-01T00:00:00Z"),
            (951_782_400.0, "2000-02-29T00:00:00Z"),
            (1_795_253_213.9, "2026-11-21T09:26:53Z"),
            (4_102_444_799.0, "2099-12-31T23:59:59Z"),
        ] {
            assert_eq!(wall_text(seconds), text);
        }
    }

    #[test]
    fn spans() {
        for (seconds, text) in [
            (-1.0, "0.0 s"),
            (0.25, "0.2 s"),
            (59.9, "59 s"),
            (125.0, "2 min 5 s"),
            (7_500.0, "2 h 5 min"),
            (180_000.0, "2 d 2 h"),
        ] {
            assert_eq!(span(seconds), text);
        }
    }
}
