//! Level of detail: like full detail, for less.

#[path = "../../benches/detail/city.rs"]
mod city;
mod images;
mod likeness;
mod poison;
