//! Obstacle map, for courses that give the map to the plugin.
//!
//! The runtime passes the content of `map.json` in an environment variable of the plugin ([`VARIABLE`]). The map is
//! therefore available even if the sandbox hides the scene's folder.

use vizflyt_protocol::geometry::Volume;

/// Environment variable with the map: a JSON array of volumes.
pub const VARIABLE: &str = "VIZFLYT_MAP";

/// Why the given map cannot be read.
#[derive(Debug, thiserror::Error)]
pub enum MapError {
    /// The text is not an array of volumes as `vizflyt scene generate` writes it.
    #[error("{VARIABLE}: {0}; it must be a JSON array of volumes, as in map.json")]
    Json(serde_json::Error),
    /// A volume has a number that is not finite, or a size that is not positive.
    #[error("{VARIABLE}: volume {0} is invalid; sizes must be positive and numbers finite")]
    Volume(usize),
}

/// Returns every obstacle of the course, or `None` if the course does not give the map. [world]
///
/// # Errors
/// If the map cannot be read.
pub fn map() -> Result<Option<Vec<Volume>>, MapError> {
    std::env::var(VARIABLE).ok().map(|text| parse_map(&text)).transpose()
}

/// Parses the text of a map. [world]
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
