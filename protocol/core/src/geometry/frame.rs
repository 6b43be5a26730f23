//! Coordinate frames as types. See `docs/COORDINATES.md` for drawings.

/// Right-handed coordinate frame. Implemented only by empty marker types.
pub trait Frame: Copy + 'static {
    /// Name of the frame in identifiers and documents.
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
    /// Room: x east, y north, z up. `arena.toml` defines the origin.
    World = "world";
    /// Vehicle: x forward, y left, z up.
    Body = "body";
    /// Camera, OpenCV convention: x right, y down, z forward.
    Cam = "cam";
    /// Splat scene as trained, before `world_from_scene` is applied.
    Scene = "scene";
    /// Frame of a plugin's own estimate: z up, arbitrary origin and heading.
    Odom = "odom";
    /// Sensor other than a camera: x forward, y left, z up.
    Sensor = "sensor";
    /// Moving rigid part of a scene: a door, a clock's hand, another vehicle.
    Object = "object";
}
