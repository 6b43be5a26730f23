//! Rates of the page's figures, measured once for all viewers.

use crate::timing::RateMeter;

#[derive(Debug, Default)]
pub(crate) struct Rates {
    pub(super) ticks: RateMeter,
    pub(super) vehicles: Vec<VehicleRates>,
}

#[derive(Debug, Default)]
pub(super) struct VehicleRates {
    pub(super) images: RateMeter,
    pub(super) bytes: RateMeter,
    pub(super) poses: RateMeter,
}

impl Rates {
    /// Returns the rates of `vehicles` vehicles.
    pub(crate) fn of(vehicles: usize) -> Self {
        let vehicles = std::iter::repeat_with(VehicleRates::default).take(vehicles).collect();
        Self { ticks: RateMeter::default(), vehicles }
    }
}
