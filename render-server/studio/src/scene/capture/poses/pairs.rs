//! Selection of pairs of pictures to compare.
//!
//! In halls with similar walls, structure from motion that compares all pairs confuses places: of 100 pictures of the
//! generated hall, all were placed with a reprojection error of 0.7 px, but with a position error of 2.9 m. Therefore,
//! pictures of a video are only compared with those shortly before and after, and with pictures of the same tag,
//! because each tag number exists only once.

use std::collections::BTreeSet;

use crate::scene::capture::images::Pictures;
use crate::scene::capture::prints::Seen;

/// Returns pairs of indices in order, the earlier picture first.
pub(super) fn of(pictures: &Pictures, seen: &Seen) -> Vec<[usize; 2]> {
    let count = pictures.pictures.len();
    let mut pairs = BTreeSet::new();
    // Photos can be in any order, and without tags only these pairs close a loop.
    let has_tags = seen.pictures.iter().any(|tags| !tags.is_empty());
    let is_loose = !(pictures.of_video && has_tags) && count <= ALL_PAIRS;
    let reach = if is_loose { count } else { WINDOW };
    for a in 0..count {
        for b in a + 1..count {
            let soon = b - a <= reach;
            // A walk in a loop ends where it began.
            let around = !has_tags && count - (b - a) <= WINDOW;
            if soon || around || share_a_tag(seen, a, b) {
                pairs.insert([a, b]);
            }
        }
    }
    pairs.into_iter().collect()
}

fn share_a_tag(seen: &Seen, a: usize, b: usize) -> bool {
    let [a, b] = [a, b].map(|i| seen.pictures.get(i).map_or(&[][..], Vec::as_slice));
    a.iter().any(|tag| b.iter().any(|other| tag.tag == other.tag))
}

/// Number of pictures of a video before and after: three seconds at 3 Hz.
const WINDOW: usize = 10;
/// Maximum number of photos of which all pairs are compared: 11,175 pairs, some minutes.
const ALL_PAIRS: usize = 150;

#[cfg(test)]
mod tests {
    use super::*;
    use crate::scene::capture::images::Picture;
    use crate::scene::capture::prints::Sighting;

    fn check(count: usize, of_video: bool, tags: &[(usize, usize)]) -> Vec<[usize; 2]> {
        let picture =
            |i: usize| Picture { name: format!("{i}.jpg"), at_s: i as f64, blur: 0.0, grey: 0.0 };
        let pictures = Pictures {
            folder: "images".into(),
            size_px: [640, 480],
            of_video,
            pictures: (0..count).map(picture).collect(),
        };
        let mut seen =
            Seen { tags: Vec::new(), pictures: vec![Vec::new(); count], names: Vec::new() };
        for &(picture, tag) in tags {
            seen.pictures[picture].push(Sighting { tag, corners_px: [[0.0; 2]; 4] });
        }
        of(&pictures, &seen)
    }

    #[test]
    fn compares_neighbours_and_pictures_of_the_same_tag() {
        let pairs = check(100, true, &[(3, 0), (90, 0), (50, 1)]);
        assert!(pairs.contains(&[3, 90]), "the tag");
        assert!(pairs.contains(&[0, 10]) && !pairs.contains(&[0, 11]), "the window");
        assert!(!pairs.contains(&[3, 50]) && !pairs.contains(&[0, 99]));
        assert_eq!(pairs.len(), 10 * 100 - 55 + 1);
    }

    #[test]
    fn compares_all_pairs_of_a_few_photos() {
        assert_eq!(check(20, false, &[(3, 0), (9, 0)]).len(), 190);
        assert_eq!(check(20, true, &[]).len(), 190);
        // Too many for all pairs: neighbours, and the end of the loop with its start.
        let pairs = check(400, true, &[]);
        assert!(pairs.contains(&[0, 399]) && !pairs.contains(&[0, 200]));
    }

    #[test]
    fn compares_no_picture_with_itself() {
        assert!(check(0, true, &[]).is_empty() && check(1, true, &[(0, 0)]).is_empty());
    }
}
