//! Checkpoints: bytes from which a training resumes at any step and ends in the same twin.
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

/// State of a training, without its dataset and options.
#[derive(Clone, Debug, PartialEq)]
pub struct Checkpoint {
    /// Hash of the dataset and options.
    training: u64,
    step: u32,
    gaussians: Gaussians,
    moments: Moments,
    errors: Vec<f32>,
    exposures: Vec<ExposureState>,
    queue: Vec<u32>,
    random: Random,
}

/// Why a training cannot resume from a checkpoint. The remedy is always to start it again.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
pub enum CheckpointError {
    /// Another file, or another version.
    #[error("not a checkpoint of this version; start the training again")]
    Other,
    /// Value out of range.
    #[error("invalid {0} in the checkpoint; start the training again")]
    Number(&'static str),
    /// Wrong length.
    #[error(
        "the checkpoint has {found} bytes, and should have {expected}; start the training again"
    )]
    Length {
        /// Actual length in bytes.
        found: usize,
        /// Length by the header, in bytes.
        expected: usize,
    },
    /// Damaged contents.
    #[error(
        "the checksum of the checkpoint does not match: it is damaged; start the training again"
    )]
    Checksum,
    /// Photos, poses or options differ.
    #[error(
        "the checkpoint has another dataset or other options; use the same as before, or start the training again"
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

    /// Reads the bytes that [`Self::to_bytes`] returns.
    ///
    /// # Errors
    /// [`CheckpointError`] for any other bytes. Allocates at most as much memory as `bytes` describes.
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

    /// Returns the number of completed steps.
    pub fn steps(&self) -> u32 {
        self.step
    }
}

impl<'a> Trainer<'a> {
    /// Returns the state that [`Self::resume`] continues from.
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

    /// Resumes a training. Its result equals that of an uninterrupted training, bit for bit on the same kind of
    /// processor.
    ///
    /// # Errors
    /// [`CheckpointError::Training`] if the checkpoint has another dataset or other options.
    ///
    /// # Panics
    /// If the dataset has no photo, or all photos are held out.
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

/// Returns a hash of the options and of the parts of the dataset that training reads.
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

/// FNV-1a (Fowler, Noll, Vo), 64 bits: detects damage, not tampering.
fn fnv1a(bytes: &[u8]) -> u64 {
    fnv1a_on(OFFSET, bytes)
}

/// Continues a hash with more bytes.
fn fnv1a_on(hash: u64, bytes: &[u8]) -> u64 {
    bytes
        .iter()
        .fold(hash, |hash, &byte| (hash ^ u64::from(byte)).wrapping_mul(0x0000_0100_0000_01b3))
}

/// Initial value of a hash.
const OFFSET: u64 = 0xcbf2_9ce4_8422_2325;

/// The last byte is the version: increase it if the format or the meaning of training steps changes.
const MAGIC: &[u8; 8] = b"viztwin\x01";
/// Magic, training, step, degree, random, 3 counts.
const HEADER: usize = 8 + 8 + 4 + 1 + 8 + 3 * 8;
/// Size of an exposure. [bytes]
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
        fn reads_back_written_checkpoints(degree in 0u8..4, rows in 0usize..9, photos in 0usize..9, seed: u64) {
            let written = checkpoint(degree, rows, photos, seed);
            prop_assert_eq!(Checkpoint::from_bytes(&written.to_bytes()), Ok(written));
        }

        #[test]
        fn detects_damage(at in 0usize..1000, bit in 0u32..8) {
            let mut bytes = checkpoint(1, 3, 4, 5).to_bytes();
            let at = at % bytes.len();
            bytes[at] ^= 1 << bit;
            prop_assert!(Checkpoint::from_bytes(&bytes).is_err());
        }

        #[test]
        fn rejects_random_bytes(mut bytes in proptest::collection::vec(any::<u8>(), 0..300)) {
            prop_assert!(Checkpoint::from_bytes(&bytes).is_err());
            // Counts of any size after a valid magic number.
            bytes.splice(0..0, *MAGIC);
            prop_assert!(Checkpoint::from_bytes(&bytes).is_err());
        }
    }

    #[test]
    fn rejects_wrong_lengths() {
        let bytes = checkpoint(0, 2, 2, 1).to_bytes();
        for length in 0..bytes.len() {
            assert!(Checkpoint::from_bytes(&bytes[..length]).is_err(), "{length}");
        }
        let longer = [&bytes[..], &[0]].concat();
        let says = Checkpoint::from_bytes(&longer).unwrap_err().to_string();
        assert!(says.contains(&format!("should have {}", bytes.len())), "{says}");
    }
}
