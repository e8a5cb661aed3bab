//! How long calls take, as histograms.

use std::{
    fmt::Write,
    sync::atomic::{AtomicU64, Ordering},
    time::Duration,
};

use ros1_master::master::Kind;

/// Upper bounds of the buckets, in microseconds. The last bucket has none.
const BOUNDS: [u64; 14] = [
    50, 100, 250, 500, 1_000, 2_500, 5_000, 10_000, 25_000, 50_000, 100_000, 250_000, 1_000_000,
    10_000_000,
];
/// Classes of methods, as the label `class`.
const CLASSES: [&str; 4] = ["identity", "read", "write", "other"];

/// The times of all calls since this process started, by class of method.
#[derive(Debug, Default)]
pub(crate) struct CallTimes([Histogram; CLASSES.len()]);

#[derive(Debug, Default)]
struct Histogram {
    buckets: [AtomicU64; BOUNDS.len() + 1],
    nanoseconds: AtomicU64,
}

impl CallTimes {
    /// Counts a call of this kind that took `time`. A call that cannot be decoded has no kind.
    pub(crate) fn count(&self, kind: Option<Kind>, time: Duration) {
        let [identity, read, write, other] = &self.0;
        let histogram = match kind {
            Some(Kind::Identity) => identity,
            Some(Kind::Read) => read,
            Some(Kind::Unregister | Kind::Mutate) => write,
            Some(Kind::Unknown | Kind::Shutdown) | None => other,
        };
        let nanoseconds = u64::try_from(time.as_nanos()).unwrap_or(u64::MAX);
        let bucket = BOUNDS.partition_point(|bound| bound * 1_000 < nanoseconds);
        if let Some(bucket) = histogram.buckets.get(bucket) {
            bucket.fetch_add(1, Ordering::Relaxed);
        }
        histogram
            .nanoseconds
            .fetch_add(nanoseconds, Ordering::Relaxed);
    }

    /// Writes the samples of the metric `name` in Prometheus' text format.
    pub(super) fn write(&self, text: &mut String, name: &str) {
        for (class, histogram) in CLASSES.iter().zip(&self.0) {
            let mut count = 0;
            let bounds = BOUNDS.iter().map(|&bound| (bound as f64 / 1e6).to_string());
            for (bucket, bound) in histogram
                .buckets
                .iter()
                .zip(bounds.chain(["+Inf".to_owned()]))
            {
                count += bucket.load(Ordering::Relaxed);
                // Writing to a string does not fail.
                let _ = writeln!(
                    text,
                    "{name}_bucket{{class=\"{class}\",le=\"{bound}\"}} {count}"
                );
            }
            let sum = histogram.nanoseconds.load(Ordering::Relaxed) as f64 / 1e9;
            let _ = writeln!(text, "{name}_sum{{class=\"{class}\"}} {sum}");
            let _ = writeln!(text, "{name}_count{{class=\"{class}\"}} {count}");
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_call_counts_in_its_bucket_and_in_all_above() {
        let times = CallTimes::default();
        times.count(Some(Kind::Read), Duration::from_micros(100));
        times.count(Some(Kind::Read), Duration::from_micros(101));
        times.count(Some(Kind::Unregister), Duration::from_secs(60));
        times.count(None, Duration::ZERO);
        let mut text = String::new();
        times.write(&mut text, "t");
        for line in [
            r#"t_bucket{class="read",le="0.00005"} 0"#,
            r#"t_bucket{class="read",le="0.0001"} 1"#,
            r#"t_bucket{class="read",le="0.00025"} 2"#,
            r#"t_bucket{class="read",le="+Inf"} 2"#,
            r#"t_sum{class="read"} 0.000201"#,
            r#"t_count{class="read"} 2"#,
            r#"t_bucket{class="write",le="10"} 0"#,
            r#"t_bucket{class="write",le="+Inf"} 1"#,
            r#"t_bucket{class="other",le="0.00005"} 1"#,
            r#"t_count{class="identity"} 0"#,
        ] {
            assert!(text.lines().any(|found| found == line), "{line}\n{text}");
        }
    }
}
