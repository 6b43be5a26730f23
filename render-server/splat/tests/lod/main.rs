//! Level of detail: images similar to full detail, at lower cost.

#[path = "../../benches/detail/city.rs"]
mod city;
mod images;
mod lawn;
mod likeness;
mod poison;
#[allow(dead_code, reason = "the renderer for graphics cards is tested with more of it")]
#[path = "../gpu/twins.rs"]
mod twins;
