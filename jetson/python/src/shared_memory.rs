//! Memory of an observation, and numpy arrays that lie in it.
//!
//! An array keeps its [`Memory`] alive through its base object, so kept arrays do not change: the runtime does
//! not write to borrowed memory. It lends at most [`BORROWED_OBSERVATIONS`]. When a plugin has kept all but the
//! last of them, new observations are copied to owned memory and returned at once ([`Lender::take`]).

use std::sync::Arc;
use std::sync::atomic::{AtomicUsize, Ordering};

use numpy::ndarray::{ArrayView2, ArrayView3};
use numpy::{PyArray2, PyArray3, PyArrayMethods};
use pyo3::prelude::*;
use vizflyt_sdk::ipc::{BORROWED_OBSERVATIONS, ObservationSample};
use vizflyt_sdk::protocol::messages::Name;
use zerocopy::{FromBytes, IntoBytes};

use crate::observation::CameraImage;

/// Bytes of one observation, in shared or owned memory.
pub(crate) struct Memory {
    bytes: Bytes,
    /// Names of the cameras, in the order of their index.
    pub(crate) names: Arc<[Name]>,
}

enum Bytes {
    Shared {
        sample: ObservationSample,
        _loan: Loan,
    },
    /// In units of 8 bytes, the alignment of the layout.
    Own(Vec<u64>),
}

/// Counts observations borrowed from the runtime.
#[derive(Clone, Default)]
pub(crate) struct Lender(Arc<AtomicUsize>);

struct Loan(Arc<AtomicUsize>);

impl Drop for Loan {
    fn drop(&mut self) {
        self.0.fetch_sub(1, Ordering::Relaxed);
    }
}

impl Lender {
    /// Returns the memory of an observation; a copy if this one would use the last slot.
    pub(crate) fn take(&self, sample: ObservationSample, names: Arc<[Name]>) -> Memory {
        if self.0.load(Ordering::Relaxed) + 1 >= BORROWED_OBSERVATIONS {
            return Memory::copied(sample.bytes(), names);
        }
        self.0.fetch_add(1, Ordering::Relaxed);
        Memory { bytes: Bytes::Shared { sample, _loan: Loan(Arc::clone(&self.0)) }, names }
    }
}

impl Memory {
    /// Returns a copy of an observation's bytes.
    pub(crate) fn copied(bytes: &[u8], names: Arc<[Name]>) -> Self {
        let mut own = vec![0_u64; bytes.len().div_ceil(size_of::<u64>())];
        own.as_mut_bytes()[..bytes.len()].copy_from_slice(bytes);
        Self { bytes: Bytes::Own(own), names }
    }

    /// Returns the bytes; they neither move nor change.
    pub(crate) fn bytes(&self) -> &[u8] {
        match &self.bytes {
            Bytes::Shared { sample, .. } => sample.bytes(),
            Bytes::Own(own) => own.as_bytes(),
        }
    }

    /// Returns whether it is a copy.
    pub(crate) fn is_copy(&self) -> bool {
        matches!(self.bytes, Bytes::Own(_))
    }
}

/// Returns the bytes of `memory` from `at` on as a read-only array (H, W, 3) with the base `owner`.
pub(crate) fn rgb_array<'py>(
    owner: &Bound<'py, CameraImage>,
    at: usize,
    (height, width): (usize, usize),
) -> Bound<'py, PyArray3<u8>> {
    let plane = &owner.get().memory().bytes()[at..at + 3 * height * width];
    let view = ArrayView3::from_shape((height, width, 3), plane).expect("sized above");
    // SAFETY: `owner` becomes the array's base. It is frozen and owns the memory through an `Arc`, whose bytes
    // neither move nor change while it lives: borrowed shared memory, or a vector that no other code can access.
    // The array is made read-only before other code sees it.
    let array = unsafe { PyArray3::borrow_from_array(&view, owner.clone().into_any()) };
    array.readwrite().make_nonwriteable();
    array
}

/// As [`rgb_array`], for 16-bit numbers (H, W).
pub(crate) fn depth_array<'py>(
    owner: &Bound<'py, CameraImage>,
    at: usize,
    (height, width): (usize, usize),
) -> Bound<'py, PyArray2<u16>> {
    let plane = &owner.get().memory().bytes()[at..at + 2 * height * width];
    let plane = <[u16]>::ref_from_bytes(plane).expect("checked when parsed");
    let view = ArrayView2::from_shape((height, width), plane).expect("sized above");
    // SAFETY: as in `rgb_array`.
    let array = unsafe { PyArray2::borrow_from_array(&view, owner.clone().into_any()) };
    array.readwrite().make_nonwriteable();
    array
}
