//! Coordinate frames as types. `docs/COORDINATES.md` draws them.

/// A right-handed coordinate frame; implemented by empty marker types only.
pub trait Frame: Copy + 'static {
    /// The frame's name as it stands in identifiers and documents.
    const NAME: &'static str;
}

macro_rules! frames {
    ($($(#[$doc:meta])* $name:ident = $text:literal;)*) => {$(
        $(#[$doc])*
        #[derive(Clone, Copy, Debug, PartialEq, Eq)]
        pub enum $name {}
        impl Frame for $name {
            const NAME: &'static str = $text;
        }
    )*};
}

frames! {
    /// The room: x east, y north, z up; origin stated in `arena.toml`.
    World = "world";
    /// The vehicle: x forward, y left, z up.
    Body = "body";
    /// A camera, OpenCV convention: x right, y down, z forward.
    Cam = "cam";
    /// A splat scene as trained, before `world_from_scene` is baked in.
    Scene = "scene";
    /// Where a plugin's own estimate begins: z up, origin and heading as it likes.
    Odom = "odom";
    /// A sensor that is no camera: x forward, y left, z up.
    Sensor = "sensor";
    /// A rigid part of a scene that moves: a door, a clock's hand, another vehicle.
    Object = "object";
}
