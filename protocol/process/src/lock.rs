//! Lock a mutex even after a panic.

use std::sync::{Mutex, MutexGuard, PoisonError};

/// Locks the mutex, even after a thread has panicked. For values that are always consistent.
pub fn lock<T>(mutex: &Mutex<T>) -> MutexGuard<'_, T> {
    mutex.lock().unwrap_or_else(PoisonError::into_inner)
}
