//! The random numbers of these tests.

use std::time::Duration;

use crate::support::links::Dice;

/// Random numbers of one test. `ROSRESCUE_SEED` sets the seed; by default each test gets a new one.
#[derive(Debug)]
pub(crate) struct Chance(Dice);

impl Chance {
    /// Chooses a seed and prints it, so that a failed test can be repeated.
    pub(crate) fn new() -> Self {
        use std::hash::{BuildHasher, RandomState};
        let seed = match std::env::var("ROSRESCUE_SEED") {
            Ok(seed) => seed.parse().expect("ROSRESCUE_SEED is a number"),
            Err(_) => u64::from(RandomState::new().hash_one(0) as u32),
        };
        println!("seed {seed}: ROSRESCUE_SEED={seed} takes the same random numbers");
        Self(Dice(seed))
    }

    pub(crate) fn below(&mut self, end: usize) -> usize {
        usize::try_from(self.0.below(end as u64)).unwrap()
    }

    pub(crate) fn one_in(&mut self, times: usize) -> bool {
        self.below(times) == 0
    }

    /// A random duration below `most`.
    pub(crate) fn time(&mut self, most: Duration) -> Duration {
        most.mul_f64(self.below(1 << 20) as f64 / f64::from(1 << 20))
    }

    pub(crate) fn of<T: Copy>(&mut self, choices: &[T]) -> T {
        choices[self.below(choices.len())]
    }
}
