//! Staging of a scene for a capture. Before a scene is painted, a walk is planned between its solids, and boards for
//! prints are added along the walk. [`Staging::none`] leaves a scene unchanged.

use glam::{DVec2, DVec3};
use vizflyt_arena::config::Geofence;
use vizflyt_protocol::geometry::Volume;

use crate::canvas::Canvas;
use crate::generated::{Generated, SceneKind};
use crate::prints::{self, Board, Places, Print};
use crate::solids::Solids;
use crate::walk::{Ground, NoWalk, Walk};
use crate::{forest, hall};

/// Generated scene, walk through it, and sheets along the walk.
#[derive(Clone, Debug, PartialEq)]
pub struct FilmSet {
    /// Scene; its splats and truth include the boards if sheets were requested.
    pub scene: Generated,
    /// Motion of the camera.
    pub walk: Walk,
    /// White sheets for prints; empty if not requested.
    pub prints: Vec<Print>,
}

/// Generates a scene and a closed walk of this duration. `with_prints` adds boards along the walk.
///
/// # Errors
/// [`NoWalk`] if the duration is outside of [`Walk::SECONDS`], or if there is no space for a person.
///
/// ```
/// use vizflyt_scenes::{SceneKind, film_set};
/// let set = film_set(SceneKind::Room, 3, 20.0, true)?;
/// assert!(set.prints.len() >= 6);
/// // The walk ends at its start.
/// let (begin, end) = (set.walk.world_from_cam(0.0), set.walk.world_from_cam(20.0));
/// assert!((begin.translation_m - end.translation_m).length() < 1e-9);
/// # Ok::<(), vizflyt_scenes::walk::NoWalk>(())
/// ```
pub fn film_set(
    kind: SceneKind,
    seed: u64,
    seconds: f64,
    with_prints: bool,
) -> Result<FilmSet, NoWalk> {
    let mut staging =
        Staging { asked: Some(Asked { seed, seconds, with_prints }), ..Staging::none() };
    let scene = match kind {
        SceneKind::Forest => forest::build_staged(seed, &mut staging),
        SceneKind::Race => hall::build_race(seed, &mut staging),
        SceneKind::Room => hall::build_room(seed, &mut staging),
        SceneKind::Moving => hall::build_moving(seed, &mut staging),
    };
    let walk = staging.walk.unwrap_or(Err(NoWalk::NoFloor))?;
    Ok(FilmSet { scene, walk, prints: staging.boards.iter().map(Board::print).collect() })
}

/// Request for a walk and boards, and its results. The builder of a scene fills it.
#[derive(Debug)]
pub(crate) struct Staging {
    asked: Option<Asked>,
    walk: Option<Result<Walk, NoWalk>>,
    boards: Vec<Board>,
}

#[derive(Clone, Copy, Debug)]
struct Asked {
    seed: u64,
    seconds: f64,
    with_prints: bool,
}

/// Description of a place for the planning.
pub(crate) struct Stage<'a> {
    /// Fence of the flights, which is the space to capture.
    pub(crate) fence: &'a Geofence,
    /// Width of the walkable area around the fence; negative: inside the fence. [m]
    pub(crate) around_m: f64,
    /// Walls: a point at the floor, the inward normal, and the extent to both sides of the point. [m, world]
    pub(crate) walls: &'a [(DVec3, DVec3, f64)],
    /// Volumes of moving objects, which the walk avoids. [m, world]
    pub(crate) movers: &'a [Volume],
    /// Whether posts must stand outside of the fence.
    pub(crate) fence_is_kept_free: bool,
}

impl Staging {
    /// Returns a staging without walk and boards.
    pub(crate) fn none() -> Self {
        Self { asked: None, walk: None, boards: Vec::new() }
    }

    /// Plans the walk and the boards, and adds the boards to the true solids.
    pub(crate) fn put_up(&mut self, truth: &mut Vec<Volume>, stage: &Stage<'_>) {
        let Some(Asked { seed, seconds, with_prints }) = self.asked else { return };
        let solids = Solids::new(truth.clone());
        let within_m = [stage.fence.min_m.truncate(), stage.fence.max_m.truncate()];
        let around_m = DVec2::splat(stage.around_m);
        let floor_m = [within_m[0] - around_m, within_m[1] + around_m];
        let ground = Ground { solids: &solids, keep_out: stage.movers, floor_m, within_m };
        let walk = Walk::plan(&ground, seed, seconds);
        if let (Ok(walk), true) = (&walk, with_prints) {
            let kept_free = stage.fence_is_kept_free.then_some(within_m);
            let places = Places { solids: &solids, walls: stage.walls, floor_m, kept_free };
            self.boards = prints::plan(&places, walk, seed);
            truth.extend(self.boards.iter().flat_map(Board::volumes));
        }
        self.walk = Some(walk);
    }

    /// Paints the boards. `matt(point, normal, albedo)` returns the light that leaves a matt surface.
    pub(crate) fn paint(
        &self,
        canvas: &mut Canvas,
        matt: &mut dyn FnMut(DVec3, DVec3, DVec3) -> DVec3,
    ) {
        prints::paint(canvas, &self.boards, matt);
    }
}
