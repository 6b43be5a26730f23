//! Tests of episodes in generated courses.

use glam::DVec3;
use vizflyt_scenes::Variant;
use vizflyt_scenes::projects::{CourseProject, Level};
use vizflyt_simulator::autopilot::airframe_limits;
use vizflyt_studio::course::CourseInstance;

use crate::episode::{ACTION, ActionKind, End, Episode, Manner, Rules, START_M, STATE};

const MANNER: Manner = Manner { action: ActionKind::Velocity, ticks: 10, delay: 0, seconds: 20.0 };

fn rules() -> Rules {
    let project = CourseProject::named("square").unwrap();
    let course = CourseInstance::make(&project, Level::Ug, Variant::DAY, 1).unwrap();
    Rules::new(course.arena, course.obstacles, airframe_limits())
}

fn state(episode: &Episode, rules: &Rules) -> [f32; STATE] {
    let mut state = [0.0; STATE];
    episode.write_state(rules, &MANNER, &mut state);
    state
}

#[test]
fn flies_the_commanded_velocity_and_ends_at_the_fence() {
    let rules = rules();
    let mut episode = Episode::start(&rules, &MANNER, 3);
    let most_mps = rules.arena.limits.max_speed_mps as f32;
    for _ in 0..60 {
        episode.step(&rules, &MANNER, [0.4, 0.0, 0.0, 0.0]);
    }
    let flown = state(&episode, &rules);
    // Forward in heading axes, for any heading.
    assert!((flown[0] - 0.4 * most_mps).abs() < 0.1, "{flown:?}");
    assert!(flown[1].abs() < 0.1 && flown[2].abs() < 0.1, "{flown:?}");
    assert_eq!(episode.end(), End::Flying);
    for _ in 0..400 {
        episode.step(&rules, &MANNER, [1.0, 0.0, 0.0, 0.0]);
    }
    assert!(matches!(episode.end(), End::LeftFence | End::Crashed), "{:?}", episode.end());
    let ended = state(&episode, &rules);
    episode.step(&rules, &MANNER, [-1.0; 4]);
    assert_eq!(state(&episode, &rules), ended, "an ended episode must not change");
}

#[test]
fn seed_determines_the_start_and_the_time_limit_ends_an_episode() {
    let rules = rules();
    let begin = |seed| state(&Episode::start(&rules, &MANNER, seed), &rules);
    assert_eq!(begin(1), begin(1));
    assert_ne!(begin(1), begin(2));
    let spawn_m = rules.arena.spawn.position_m + DVec3::Z * rules.arena.takeoff_height_m;
    for seed in 0..50 {
        let start = begin(seed);
        let p_m = DVec3::new(start[15].into(), start[16].into(), start[17].into());
        assert!((p_m - spawn_m).abs().max_element() <= START_M + 1e-6, "seed {seed}: {p_m}");
    }
    let short = Manner { seconds: 1.0, ..MANNER };
    let mut episode = Episode::start(&rules, &short, 1);
    for _ in 0..39 {
        episode.step(&rules, &short, [0.0; ACTION]);
        assert_eq!(episode.end(), End::Flying);
    }
    episode.step(&rules, &short, [0.0; ACTION]);
    assert_eq!(episode.end(), End::TimeUp);
}

#[test]
fn action_takes_effect_after_its_delay() {
    let rules = rules();
    let late = Manner { delay: 3, ..MANNER };
    let turned = |manner: &Manner, steps| {
        let mut episode = Episode::start(&rules, manner, 1);
        let before = state(&episode, &rules);
        for _ in 0..steps {
            episode.step(&rules, manner, [0.0, 0.0, 0.0, 1.0]);
        }
        (state(&episode, &rules)[8] - before[8]).abs()
    };
    assert!(turned(&MANNER, 3) > 0.1, "{}", turned(&MANNER, 3));
    assert!(turned(&late, 3) < 1e-3 && turned(&late, 6) > 0.1, "{}", turned(&late, 3));
}
