//! A scene that is made to be filmed: the walk through it is planned among its solids, and boards for prints are put up along
//! the walk, before anything is painted. [`Staging::none`] leaves a scene as it is.

use glam::{DVec2, DVec3};
use vizflyt_arena::config::Geofence;
use vizflyt_protocol::geometry::Volume;

use crate::canvas::Canvas;
use crate::generated::{Generated, SceneKind};
use crate::prints::{self, Board, Places, Print};
use crate::solids::Solids;
use crate::walk::{Ground, NoWalk, Walk};
use crate::{forest, hall};

/// A generated scene, a walk through it, and the sheets that were put up for it.
#[derive(Clone, Debug, PartialEq)]
pub struct FilmSet {
    /// The scene, with boards in splats and truth where sheets were asked for.
    pub scene: Generated,
    /// Where the camera is, at any instant.
    pub walk: Walk,
    /// White sheets to print on; empty where none were asked for.
    pub prints: Vec<Print>,
}

/// Generates a scene and a closed walk through it of this duration; `with_prints` puts up boards along the walk.
///
/// # Errors
/// [`NoWalk`] for a duration outside of [`Walk::SECONDS`], or where there is no room for a person.
///
/// ```
/// use vizflyt_scenes::{SceneKind, film_set};
/// let set = film_set(SceneKind::Room, 3, 20.0, true)?;
/// assert!(set.prints.len() >= 6);
/// // It ends where it began.
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

/// What is asked of a scene's builder besides the scene, and what comes of it.
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

/// What a builder knows of its place.
pub(crate) struct Stage<'a> {
    /// Where vehicles fly; what is to be filmed.
    pub(crate) fence: &'a Geofence,
    /// How far about the fence one may walk; negative keeps inside. [m]
    pub(crate) around_m: f64,
    /// Walls: a point at the floor, the inward normal, and the reach to both sides of the point. [m, world]
    pub(crate) walls: &'a [(DVec3, DVec3, f64)],
    /// What moves, and is kept away from. [m, world]
    pub(crate) movers: &'a [Volume],
    /// Whether posts stand outside of the fence only.
    pub(crate) fence_is_kept_free: bool,
}

impl Staging {
    /// Asks for nothing.
    pub(crate) fn none() -> Self {
        Self { asked: None, walk: None, boards: Vec::new() }
    }

    /// Plans the walk and the boards, which join the true solids.
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

    /// Paints the boards; `matt(point, normal, albedo)` is the light that leaves a matt surface.
    pub(crate) fn paint(
        &self,
        canvas: &mut Canvas,
        matt: &mut dyn FnMut(DVec3, DVec3, DVec3) -> DVec3,
    ) {
        prints::paint(canvas, &self.boards, matt);
    }
}
