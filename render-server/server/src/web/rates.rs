//! Rates for the page's figures, counted once for all viewers.

use crate::timing::RateMeter;

/// Rates that all viewers share.
#[derive(Debug, Default)]
pub(crate) struct Rates {
    pub(super) ticks: RateMeter,
    pub(super) vehicles: Vec<VehicleRates>,
}

/// Rates of one vehicle.
#[derive(Debug, Default)]
pub(super) struct VehicleRates {
    pub(super) images: RateMeter,
    pub(super) bytes: RateMeter,
    pub(super) poses: RateMeter,
}

impl Rates {
    /// Returns those of this many vehicles.
    pub(crate) fn of(vehicles: usize) -> Self {
        let vehicles = std::iter::repeat_with(VehicleRates::default).take(vehicles).collect();
        Self { ticks: RateMeter::default(), vehicles }
    }
}
