//! A training under way as bytes: stopped at any step and taken up again, it ends in the same twin.
//!
//! ```text
//! 8 magic, version | u64 of dataset and options | u32 step | u8 degree | u64 random | u64 rows, photos, queue | ...
//! ... rows, first moments, second moments: f32 each | f32 error of each row | exposures | u32 queue | u64 FNV-1a
//! ```
//! All numbers are little-endian. An exposure is gain, offset [3 f32 each], first and second moments [6 f32 each], and
//! its steps [u32].

use super::{ExposureState, Options, Trainer};
use crate::adam::Moments;
use crate::dataset::{Dataset, Photo};
use crate::gaussians::Gaussians;
use crate::passes::Passes;
use crate::random::Random;

/// What a training has come to, besides its dataset and options.
#[derive(Clone, Debug, PartialEq)]
pub struct Checkpoint {
    /// Of dataset and options.
    training: u64,
    step: u32,
    gaussians: Gaussians,
    moments: Moments,
    errors: Vec<f32>,
    exposures: Vec<ExposureState>,
    queue: Vec<u32>,
    random: Random,
}

/// Why a training cannot be taken up again from some bytes. Whichever it is: begin anew.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
pub enum CheckpointError {
    /// Another file, or another version of this one.
    #[error("these bytes are no training of this version; begin anew")]
    Other,
    /// A number that cannot be.
    #[error("its {0} cannot be; begin anew")]
    Number(&'static str),
    /// Too few or too many.
    #[error("it has {found} bytes, and should have {expected}; begin anew")]
    Length {
        /// Bytes there are.
        found: usize,
        /// Bytes by the header.
        expected: usize,
    },
    /// Some byte is not as it was written.
    #[error("its checksum does not match: it is damaged; begin anew")]
    Checksum,
    /// Photos, poses or options differ.
    #[error(
        "it is of another dataset, or of other options; give the same as when it was begun, or begin anew"
    )]
    Training,
}

impl Checkpoint {
    /// Returns the bytes that [`Self::from_bytes`] reads.
    pub fn to_bytes(&self) -> Vec<u8> {
        let mut bytes = Vec::new();
        bytes.extend(MAGIC);
        bytes.extend(self.training.to_le_bytes());
        bytes.extend(self.step.to_le_bytes());
        bytes.push(self.gaussians.degree);
        bytes.extend(self.random.state().to_le_bytes());
        for count in [self.gaussians.len(), self.exposures.len(), self.queue.len()] {
            bytes.extend((count as u64).to_le_bytes());
        }
        let Moments { first, second } = &self.moments;
        for list in [&self.gaussians.values, &first.values, &second.values, &self.errors] {
            bytes.extend(list.iter().flat_map(|v| v.to_le_bytes()));
        }
        for state in &self.exposures {
            let exposure = state.exposure.gain.iter().chain(&state.exposure.offset);
            let numbers = exposure.chain(&state.first).chain(&state.second);
            bytes.extend(numbers.flat_map(|v| v.to_le_bytes()));
            bytes.extend(state.steps.to_le_bytes());
        }
        bytes.extend(self.queue.iter().flat_map(|photo| photo.to_le_bytes()));
        bytes.extend(fnv1a(&bytes).to_le_bytes());
        bytes
    }

    /// Reads what [`Self::to_bytes`] returned.
    ///
    /// # Errors
    /// [`CheckpointError`] for anything else. Allocates no more than `bytes` holds.
    pub fn from_bytes(bytes: &[u8]) -> Result<Self, CheckpointError> {
        let (header, _) = bytes.split_first_chunk::<HEADER>().ok_or(CheckpointError::Other)?;
        if header[..8] != MAGIC[..] {
            return Err(CheckpointError::Other);
        }
        let word =
            |at: usize| u64::from_le_bytes(header[at..at + 8].try_into().unwrap_or_default());
        let step = u32::from_le_bytes([header[16], header[17], header[18], header[19]]);
        let degree = header[20];
        if degree > 3 {
            return Err(CheckpointError::Number("degree of the harmonics"));
        }
        let stride = Gaussians::new(degree).stride();
        let counts = [29, 37, 45].map(|at| usize::try_from(word(at)).unwrap_or(usize::MAX));
        let [rows, photos, queued] = counts;
        let length = (|| {
            let rows = rows.checked_mul(4 * (3 * stride + 1))?;
            let photos = photos.checked_mul(EXPOSURE)?;
            (HEADER + 8).checked_add(rows)?.checked_add(photos)?.checked_add(queued.checked_mul(4)?)
        })();
        if length != Some(bytes.len()) {
            let expected = length.unwrap_or(usize::MAX);
            return Err(CheckpointError::Length { found: bytes.len(), expected });
        }
        let (all, sum) = bytes.split_at(bytes.len() - 8);
        if fnv1a(all).to_le_bytes() != *sum {
            return Err(CheckpointError::Checksum);
        }

        let mut rest = &all[HEADER..];
        let mut words = |count: usize| -> Vec<[u8; 4]> {
            let (words, more) = rest.split_at(4 * count);
            rest = more;
            words.chunks_exact(4).map(|w| [w[0], w[1], w[2], w[3]]).collect()
        };
        let mut numbers =
            |count: usize| words(count).into_iter().map(f32::from_le_bytes).collect::<Vec<f32>>();
        let mut row_numbers = || Gaussians { degree, values: numbers(rows * stride) };
        let gaussians = row_numbers();
        let moments = Moments { first: row_numbers(), second: row_numbers() };
        let errors = numbers(rows);
        let exposures: Vec<ExposureState> =
            words(photos * EXPOSURE / 4).chunks_exact(EXPOSURE / 4).map(exposure).collect();
        let queue: Vec<u32> = words(queued).into_iter().map(u32::from_le_bytes).collect();
        if queue.len() > photos || queue.iter().any(|&photo| photo as usize >= photos) {
            return Err(CheckpointError::Number("queue of photos"));
        }
        if exposures.iter().any(|state| state.steps < 0) {
            return Err(CheckpointError::Number("steps of an exposure"));
        }
        let (training, random) = (word(8), Random::new(word(21)));
        Ok(Self { training, step, gaussians, moments, errors, exposures, queue, random })
    }

    /// Returns the steps done.
    pub fn steps(&self) -> u32 {
        self.step
    }
}

impl<'a> Trainer<'a> {
    /// Returns what [`Self::resume`] goes on from.
    pub fn checkpoint(&self) -> Checkpoint {
        Checkpoint {
            training: training(self.dataset, &self.options),
            step: self.step,
            gaussians: self.gaussians.clone(),
            moments: self.moments.clone(),
            errors: self.errors.clone(),
            exposures: self.exposures.clone(),
            queue: self.queue.iter().map(|&photo| photo as u32).collect(),
            random: self.random.clone(),
        }
    }

    /// Takes up a training again, which then ends as one that was never interrupted: bit for bit on the same kind
    /// of processor.
    ///
    /// # Errors
    /// [`CheckpointError::Training`] if it was of another dataset or of other options.
    ///
    /// # Panics
    /// If the dataset has no photo, or all are held out.
    pub fn resume(
        dataset: &'a Dataset,
        options: Options,
        passes: Passes,
        checkpoint: Checkpoint,
    ) -> Result<Self, CheckpointError> {
        let Checkpoint { step, gaussians, moments, errors, exposures, queue, random, .. } =
            checkpoint;
        let fits = gaussians.degree == options.degree
            && exposures.len() == dataset.photos.len()
            && step <= options.steps;
        if checkpoint.training != training(dataset, &options) || !fits {
            return Err(CheckpointError::Training);
        }
        let queue = queue.into_iter().map(|photo| photo as usize).collect();
        let begun = Self::with(dataset, options, passes);
        let timed_from = step;
        Ok(Self { gaussians, moments, exposures, errors, queue, random, step, timed_from, ..begun })
    }
}

/// Returns a number that tells trainings apart: by options, and by what is looked at in the dataset.
fn training(dataset: &Dataset, options: &Options) -> u64 {
    let mut hash = fnv1a_on(OFFSET, format!("{options:?} {}", dataset.points.len()).as_bytes());
    for Photo { view, target, .. } in &dataset.photos {
        hash = fnv1a_on(hash, format!("{view:?}").as_bytes());
        hash = fnv1a_on(fnv1a_on(hash, &target.rgb), &target.mask);
        for point in &target.points {
            hash = fnv1a_on(fnv1a_on(hash, &point.pixel.to_le_bytes()), &point.z.to_le_bytes());
        }
        for z in &target.depth {
            hash = fnv1a_on(hash, &z.to_le_bytes());
        }
    }
    hash
}

fn exposure(words: &[[u8; 4]]) -> ExposureState {
    let number = |at: usize| f32::from_le_bytes(words[at]);
    let mut state = ExposureState::default();
    state.exposure.gain = std::array::from_fn(number);
    state.exposure.offset = std::array::from_fn(|k| number(3 + k));
    state.first = std::array::from_fn(|k| number(6 + k));
    state.second = std::array::from_fn(|k| number(12 + k));
    state.steps = i32::from_le_bytes(words[18]);
    state
}

/// FNV-1a (Fowler, Noll, Vo), 64 bits: finds damage, not malice.
fn fnv1a(bytes: &[u8]) -> u64 {
    fnv1a_on(OFFSET, bytes)
}

/// Goes on with a hash.
fn fnv1a_on(hash: u64, bytes: &[u8]) -> u64 {
    bytes
        .iter()
        .fold(hash, |hash, &byte| (hash ^ u64::from(byte)).wrapping_mul(0x0000_0100_0000_01b3))
}

/// What a hash begins with.
const OFFSET: u64 = 0xcbf2_9ce4_8422_2325;

/// The last is the version: raise it when bytes, or steps of a training, mean something else.
const MAGIC: &[u8; 8] = b"viztwin\x01";
/// Magic, training, step, degree, random, 3 counts.
const HEADER: usize = 8 + 8 + 4 + 1 + 8 + 3 * 8;
/// Bytes of an exposure.
const EXPOSURE: usize = 19 * 4;

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    fn checkpoint(degree: u8, rows: usize, photos: usize, seed: u64) -> Checkpoint {
        let mut random = Random::new(seed);
        let stride = Gaussians::new(degree).stride();
        let mut numbers = |count: usize| (0..count).map(|_| random.normal()).collect::<Vec<f32>>();
        let mut rows_of = || Gaussians { degree, values: numbers(rows * stride) };
        Checkpoint {
            training: seed,
            step: seed as u32,
            gaussians: rows_of(),
            moments: Moments { first: rows_of(), second: rows_of() },
            errors: numbers(rows),
            exposures: (0..photos)
                .map(|_| {
                    let words: Vec<[u8; 4]> =
                        numbers(19).into_iter().map(|v| v.abs().to_le_bytes()).collect();
                    exposure(&words)
                })
                .collect(),
            queue: (0..photos as u32).rev().step_by(2).collect(),
            random: Random::new(seed ^ 0xabcd),
        }
    }

    proptest! {
        #[test]
        fn what_is_written_is_read(degree in 0u8..4, rows in 0usize..9, photos in 0usize..9, seed: u64) {
            let written = checkpoint(degree, rows, photos, seed);
            prop_assert_eq!(Checkpoint::from_bytes(&written.to_bytes()), Ok(written));
        }

        #[test]
        fn damage_is_found(at in 0usize..1000, bit in 0u32..8) {
            let mut bytes = checkpoint(1, 3, 4, 5).to_bytes();
            let at = at % bytes.len();
            bytes[at] ^= 1 << bit;
            prop_assert!(Checkpoint::from_bytes(&bytes).is_err());
        }

        #[test]
        fn noise_is_refused(mut bytes in proptest::collection::vec(any::<u8>(), 0..300)) {
            prop_assert!(Checkpoint::from_bytes(&bytes).is_err());
            // Counts of any size, with the right beginning.
            bytes.splice(0..0, *MAGIC);
            prop_assert!(Checkpoint::from_bytes(&bytes).is_err());
        }
    }

    #[test]
    fn every_other_length_is_refused() {
        let bytes = checkpoint(0, 2, 2, 1).to_bytes();
        for length in 0..bytes.len() {
            assert!(Checkpoint::from_bytes(&bytes[..length]).is_err(), "{length}");
        }
        let longer = [&bytes[..], &[0]].concat();
        let says = Checkpoint::from_bytes(&longer).unwrap_err().to_string();
        assert!(says.contains(&format!("should have {}", bytes.len())), "{says}");
    }
}
