//! The map of a course whose map is known.
//!
//! The runtime puts it into the environment of the plugin that it starts ([`VARIABLE`]), as `map.json`
//! has it: whatever the plugin may not read or where the scene lies, the map is there.

use vizflyt_protocol::geometry::Volume;

/// The environment variable: a JSON array of volumes.
pub const VARIABLE: &str = "VIZFLYT_MAP";

/// Why there is no map although one was handed over.
#[derive(Debug, thiserror::Error)]
pub enum MapError {
    /// It is not what `vizflyt scene generate` writes.
    #[error("{VARIABLE}: {0}; it must be a JSON array of volumes, as in map.json")]
    Json(serde_json::Error),
    /// A number in it is not finite, a size not positive.
    #[error("{VARIABLE}: volume {0} is none; sizes must be positive and numbers finite")]
    Volume(usize),
}

/// Returns every obstacle of the course, where its map is known; `None` where it is not. [world]
///
/// # Errors
/// A map that cannot be read.
pub fn map() -> Result<Option<Vec<Volume>>, MapError> {
    std::env::var(VARIABLE).ok().map(|text| parse_map(&text)).transpose()
}

/// Returns the obstacles of a map's text. [world]
///
/// # Errors
/// [`MapError`].
///
/// ```
/// let text = r#"[{"sphere": {"center_m": [1.0, 2.0, 3.0], "radius_m": 0.5}}]"#;
/// let map = vizflyt_sdk::parse_map(text).unwrap();
/// assert!((map[0].signed_distance_m([1.0, 2.0, 4.0].into()) - 0.5).abs() < 1e-12);
/// assert!(vizflyt_sdk::parse_map("[1]").unwrap_err().to_string().contains("map.json"));
/// ```
pub fn parse_map(text: &str) -> Result<Vec<Volume>, MapError> {
    let volumes: Vec<Volume> = serde_json::from_str(text).map_err(MapError::Json)?;
    match volumes.iter().position(|volume| !volume.is_valid()) {
        Some(index) => Err(MapError::Volume(index)),
        None => Ok(volumes),
    }
}
