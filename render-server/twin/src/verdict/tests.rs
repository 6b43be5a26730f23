//! Verdicts about a synthetic hall: correct, and with known kinds of errors.

use glam::{DQuat, DVec3};
use proptest::prelude::*;
use vizflyt_protocol::geometry::Pose;

use super::*;
use crate::adjust::synthetic::{Hall, hall};
use crate::adjust::{Options, TagSighting, adjust};

/// Returns a walk of 40 images.
fn good(seed: u64) -> Hall {
    hall(seed, 40, 2400, 0.4).found(seed + 77, 0.01)
}

fn given(hall: &Hall) -> Vec<Given> {
    let images = hall.capture.images.iter();
    images.map(|image| Given { name: image.name.clone(), at_s: Some(image.at_s) }).collect()
}

fn photos(hall: &Hall) -> Vec<Given> {
    given(hall).into_iter().map(|image| Given { at_s: None, ..image }).collect()
}

fn judged(given: &[Given], capture: &Capture, others: &[Capture]) -> Verdict {
    let adjusted = adjust(capture, Options::default());
    judge(&Evidence { given, capture, adjusted: adjusted.as_ref(), others, aligned: None })
}

fn refused(verdict: &Verdict, check: Check) -> &Finding {
    let found = verdict
        .findings
        .iter()
        .find(|finding| finding.check == check && finding.severity == Severity::Refused);
    assert!(!verdict.is_fit_to_fly());
    let found = found.unwrap_or_else(|| panic!("{check:?} is not refused: {verdict:#?}"));
    assert!(!found.remedy.is_empty() && !found.what.is_empty());
    found
}

/// Moves images by a transform in `scene`; points that other images also see stay.
fn move_images(
    capture: &mut Capture,
    images: Range<usize>,
    by: impl Fn(DVec3) -> DVec3,
    turn: DQuat,
) {
    let outside: std::collections::HashSet<usize> = capture
        .images
        .iter()
        .enumerate()
        .filter(|(index, _)| !images.contains(index))
        .flat_map(|(_, image)| image.seen.iter().map(|seen| seen.point))
        .collect();
    let mut own = std::collections::BTreeSet::new();
    for image in &mut capture.images[images] {
        // Structure from motion would reject the points that joined the two parts.
        image.seen.retain(|seen| !outside.contains(&seen.point));
        own.extend(image.seen.iter().map(|seen| seen.point));
        let pose = image.scene_from_cam;
        image.scene_from_cam =
            Pose::new(by(pose.translation_m), (turn * pose.rotation).normalize());
    }
    for point in own {
        capture.points[point] = by(capture.points[point]);
    }
}

proptest! {
    // Contradictory captures take long to adjust.
    #![proptest_config(ProptestConfig::with_cases(1))]

    #[test]
    fn detects_a_half_rotated_onto_the_other(seed in 0..1000u64) {
        let mut hall = good(seed);
        // Half a turn about the vertical through the hall's centre, in structure from motion's frame.
        let turn = DQuat::from_scaled_axis(DVec3::new(1.1, -0.4, 2.0));
        let about = turn * DQuat::from_rotation_z(std::f64::consts::PI) * turn.conjugate();
        let middle = DVec3::new(3.0, -1.0, 0.5);
        move_images(&mut hall.capture, 10..30, |p| middle + about * (p - middle), about);
        // Adjust once for film and photos.
        let adjusted = adjust(&hall.capture, Options::default());
        let judged = |given: &[Given]| {
            let (capture, adjusted) = (&hall.capture, adjusted.as_ref());
            judge(&Evidence { given, capture, adjusted, others: &[], aligned: None })
        };
        let verdict = judged(&given(&hall));
        refused(&verdict, Check::Continuity);
        let tags = verdict.findings.iter().any(|f| f.check == Check::Tags || f.check == Check::Metric);
        prop_assert!(tags, "{verdict:#?}");
        let verdict = judged(&photos(&hall));
        prop_assert!(!verdict.is_fit_to_fly(), "{verdict:#?}");
    }
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(3))]

    #[test]
    fn accepts_a_correct_walk(seed in 0..1000u64) {
        let hall = good(seed);
        let verdict = judged(&given(&hall), &hall.capture, std::slice::from_ref(&hall.capture));
        prop_assert!(verdict.findings.is_empty(), "{verdict:#?}");
        prop_assert!(verdict.checked.len() >= 7, "{verdict:#?}");
    }

    #[test]
    fn detects_a_displaced_part(seed in 0..1000u64, first in 5..25usize, far in 4.0..20.0f64) {
        let mut hall = good(seed);
        // 1 m is 0.37 units.
        let by = DVec3::new(0.37 * far, 0.0, 0.0);
        move_images(&mut hall.capture, first..first + 10, |p| p + by, DQuat::IDENTITY);
        let verdict = judged(&given(&hall), &hall.capture, &[]);
        let found = refused(&verdict, Check::Continuity);
        prop_assert!(found.images.iter().any(|run| run.contains(&first)), "{found:?}");
        refused(&verdict, Check::Connected);
        // Photos have no times, but the shared points still reveal the jump.
        let verdict = judged(&photos(&hall), &hall.capture, &[]);
        prop_assert!(!verdict.findings.iter().any(|f| f.check == Check::Continuity), "{verdict:#?}");
        let found = refused(&verdict, Check::Connected);
        prop_assert!(!found.what.contains(" s)"), "the message has a time: {}", found.what);
    }

    #[test]
    fn names_a_displaced_tag(seed in 0..1000u64, tag in 0..12usize, off_m in 0.3..2.0f64) {
        let mut hall = good(seed);
        for corner in hall.capture.tags[tag].corners_m.as_mut().unwrap() {
            corner.z += off_m;
        }
        let verdict = judged(&given(&hall), &hall.capture, &[]);
        let found = refused(&verdict, Check::Tags);
        let name = format!("tag36h11 {tag} ");
        prop_assert!(format!("{} ", found.what).contains(&name), "{found:?}");
    }

    #[test]
    fn detects_two_tags_with_one_number(seed in 0..1000u64, with in 3..10usize) {
        let mut hall = good(seed);
        for image in &mut hall.capture.images {
            for seen in &mut image.tags {
                if seen.tag == 0 {
                    *seen = TagSighting { tag: with, ..*seen };
                }
            }
        }
        let verdict = judged(&given(&hall), &hall.capture, &[]);
        refused(&verdict, Check::Tags);
    }

    #[test]
    fn detects_wrong_print_sizes(seed in 0..1000u64, size in prop_oneof![0.85..0.95f64, 1.06..1.2f64]) {
        let mut hall = good(seed);
        for tag in &mut hall.capture.tags {
            tag.size_m *= size;
            let corners = tag.corners_m.as_mut().unwrap();
            let middle = corners.iter().sum::<DVec3>() / 4.0;
            for corner in corners {
                *corner = middle + (*corner - middle) * size;
            }
        }
        refused(&judged(&given(&hall), &hall.capture, &[]), Check::Tags);
    }
}

/// A tag seen by only three images from one side, with blur: its rays meet elsewhere, although each image sees it
/// within two pixels of its position.
#[test]
fn accepts_a_tag_seen_badly_by_few_images() {
    for seed in [8, 9, 10] {
        let mut hall = good(seed);
        let sees = |hall: &Hall, tag| -> Vec<usize> {
            let images = hall.capture.images.iter().enumerate();
            images.filter(|(_, i)| i.tags.iter().any(|s| s.tag == tag)).map(|(n, _)| n).collect()
        };
        let images = sees(&hall, 4);
        let kept = &images[images.len() / 2 - 1..images.len() / 2 + 2];
        for (number, image) in hall.capture.images.iter_mut().enumerate() {
            image.tags.retain(|seen| seen.tag != 4 || kept.contains(&number));
            let Some(place) = kept.iter().position(|kept| *kept == number) else { continue };
            for seen in image.tags.iter_mut().filter(|seen| seen.tag == 4) {
                seen.corners_px.iter_mut().for_each(|px| px.x += 3.2 * (place as f64 - 1.0));
            }
        }
        let adjusted = adjust(&hall.capture, Options::default()).unwrap();
        let held = adjusted.tags[4].unwrap().held_out.unwrap();
        println!("{held:?}");
        assert!(held.off_m.unwrap() > 0.15, "it would not have been refused: {held:?}");
        let verdict = judged(&given(&hall), &hall.capture, &[]);
        assert!(verdict.is_fit_to_fly(), "{verdict:#?}");
        assert!(verdict.checked.iter().any(|line| line.contains("too few sides")), "{verdict:#?}");
    }
}

/// 2.5 cm at short distance: more pixels than any detection error, but not another position.
#[test]
fn accepts_a_slightly_wrong_tag_measurement() {
    let mut hall = good(11);
    for corner in hall.capture.tags[3].corners_m.as_mut().unwrap() {
        corner.z += 0.025;
    }
    let verdict = judged(&given(&hall), &hall.capture, &[]);
    assert!(verdict.is_fit_to_fly(), "{verdict:#?}");
}

#[test]
fn scale_is_unknown_without_tags() {
    let mut hall = good(3);
    hall.capture.tags.clear();
    hall.capture.images.iter_mut().for_each(|image| image.tags.clear());
    let verdict = judged(&given(&hall), &hall.capture, &[]);
    assert!(refused(&verdict, Check::Metric).what.contains("scale is unknown"), "{verdict:?}");
    // A manual alignment gives the scale.
    let adjusted = adjust(&hall.capture, Options::default()).unwrap();
    let fit = Fit {
        world_from_scene: adjusted.world_from_scene,
        rms_m: 0.01,
        worst_m: 0.01,
        used: 4,
        left_out: 0,
        scale_sigma: 1e-3,
        tilt_sigma_rad: 1e-3,
        yaw_sigma_rad: 1e-3,
        place_sigma_m: 0.01,
        middle_m: DVec3::ZERO,
    };
    let given = given(&hall);
    let adjusted = Ok(&adjusted);
    let capture = &hall.capture;
    let evidence = Evidence { given: &given, capture, adjusted, others: &[], aligned: Some(&fit) };
    assert_eq!(judge(&evidence).findings, []);
}

#[test]
fn reports_unplaced_images_with_their_times() {
    let mut hall = good(4);
    let all = given(&hall);
    hall.capture.images.drain(20..23);
    let verdict = judged(&all, &hall.capture, &[]);
    assert!(verdict.is_fit_to_fly(), "{verdict:#?}");
    assert_eq!(verdict.findings[0].images, vec![20..23]);
    let what = &verdict.findings[0].what;
    assert!(
        what.contains("3 of 40") && what.contains("020.jpg to 022.jpg (10.0 s to 11.0 s)"),
        "{what}"
    );
    hall.capture.images.drain(20..26);
    refused(&judged(&all, &hall.capture, &[]), Check::Placed);
}

#[test]
fn reports_a_disagreeing_second_model() {
    let hall = good(5);
    let mut other = hall.capture.clone();
    for image in &mut other.images[25..32] {
        image.scene_from_cam.translation_m += DVec3::new(0.3, 0.1, 0.0);
    }
    let verdict = judged(&given(&hall), &hall.capture, &[other]);
    assert_eq!(refused(&verdict, Check::SecondModel).images, vec![25..32]);
}

#[test]
fn reports_parts_joined_by_few_points() {
    let mut hall = good(6);
    // Only a dozen points connect images 10 to 25 with the rest.
    let inside: std::collections::HashSet<usize> =
        hall.capture.images[10..25].iter().flat_map(|i| i.seen.iter().map(|s| s.point)).collect();
    let outside = hall.capture.images[..10].iter().chain(&hall.capture.images[25..]);
    let outside: std::collections::HashSet<usize> =
        outside.flat_map(|i| i.seen.iter().map(|s| s.point)).collect();
    let mut common: Vec<usize> = inside.intersection(&outside).copied().collect();
    common.sort_unstable();
    let gone: std::collections::HashSet<usize> = common[12..].iter().copied().collect();
    for image in &mut hall.capture.images[10..25] {
        image.seen.retain(|seen| !gone.contains(&seen.point));
    }
    let verdict = judged(&given(&hall), &hall.capture, &[]);
    let found = refused(&verdict, Check::Connected);
    assert!(found.what.contains("12 points"), "{found:?}");
    assert_eq!(found.images, vec![10..25]);
}

#[test]
fn detects_two_similar_rooms_merged_into_one() {
    let mut hall = good(7);
    // Every second image shows another room: its points are about 1 cm away from those of the first.
    let count = hall.capture.points.len();
    let mut random = crate::random::Random::new(9);
    let copies: Vec<DVec3> = hall
        .capture
        .points
        .iter()
        .map(|p| *p + DVec3::splat(0.01) * f64::from(random.normal()))
        .collect();
    hall.capture.points.extend(copies);
    for image in hall.capture.images.iter_mut().skip(1).step_by(2) {
        image.seen.iter_mut().for_each(|seen| seen.point += count);
    }
    let evidence = given(&hall);
    let error = crate::adjust::AdjustError::Undetermined;
    let capture = &hall.capture;
    let evidence =
        Evidence { given: &evidence, capture, adjusted: Err(&error), others: &[], aligned: None };
    refused(&judge(&evidence), Check::Doubled);
}
