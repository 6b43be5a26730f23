//! Level of detail: like full detail, for less.

#[path = "../../benches/detail/city.rs"]
mod city;
mod images;
mod lawn;
mod likeness;
mod poison;
#[allow(dead_code, reason = "the renderer for graphics cards is tested with more of it")]
#[path = "../gpu/twins.rs"]
mod twins;
