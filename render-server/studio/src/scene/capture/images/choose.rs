//! Selection of pictures from a video, and remarks about their quality.

use super::{Choice, FRAMES, Pictures, clock};

/// Time intervals of a video. The sharpest picture of each is selected.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct Buckets {
    count: usize,
    bucket_s: f64,
}

impl Buckets {
    pub(super) fn new(duration_s: f64, choice: Choice) -> Self {
        let usual = (PER_SECOND * duration_s).round() as usize;
        let count = choice.frames.unwrap_or(usual.clamp(*FRAMES.start(), *FRAMES.end())).max(1);
        Self { count, bucket_s: duration_s.max(1e-3) / count as f64 }
    }

    /// Returns the index of the interval of a time. `None` near the ends of an interval, so that selected pictures are
    /// neither too close together nor two intervals apart. For a low frame rate, all pictures are considered.
    pub(super) fn find(&self, at_s: f64, rate_hz: f64) -> Option<usize> {
        let place = at_s / self.bucket_s;
        let bucket = (place.max(0.0) as usize).min(self.count - 1);
        let is_sparse = self.bucket_s * rate_hz < SPARSE;
        (is_sparse || (place - bucket as f64 - 0.5).abs() <= MIDDLE / 2.0).then_some(bucket)
    }
}

/// Returns remarks about blur and brightness, for the user.
pub(super) fn remarks(of: &Pictures) -> Vec<String> {
    let pictures = &of.pictures;
    let mut remarks = Vec::new();
    let place = |i: usize| {
        if of.of_video { clock(pictures[i].at_s) } else { pictures[i].name.clone() }
    };
    let mut blurs: Vec<f64> = pictures.iter().map(|picture| picture.blur).collect();
    blurs.sort_by(f64::total_cmp);
    let usual = blurs.get(blurs.len() / 2).copied().unwrap_or(0.0);
    let blurred: Vec<usize> =
        (0..pictures.len()).filter(|&i| pictures[i].blur > usual + BLURRED).collect();
    if !blurred.is_empty() {
        remarks.push(format!(
            "{} of {} pictures are blurred ({}): turn more slowly, or switch on more light",
            blurred.len(),
            pictures.len(),
            spans(&blurred, place)
        ));
    }
    let jumps: Vec<usize> = (1..pictures.len())
        .filter(|&i| {
            let ratio = (pictures[i].grey + 1.0) / (pictures[i - 1].grey + 1.0);
            !(1.0 / JUMP..=JUMP).contains(&ratio)
        })
        .collect();
    if !jumps.is_empty() {
        remarks.push(format!(
            "the brightness jumps {} times ({}): lock the exposure, and keep windows out of the picture",
            jumps.len(),
            spans(&jumps, place)
        ));
    }
    remarks
}

/// Returns runs of numbers as text: "0:07 to 0:09, 0:31".
fn spans(numbers: &[usize], place: impl Fn(usize) -> String) -> String {
    let mut runs: Vec<[usize; 2]> = Vec::new();
    for &number in numbers {
        match runs.last_mut() {
            Some(run) if run[1] + 1 == number => run[1] = number,
            _ => runs.push([number; 2]),
        }
    }
    let more = runs.len().saturating_sub(MOST_SPANS);
    runs.truncate(MOST_SPANS);
    let text = |&[first, last]: &[usize; 2]| {
        let (first, last) = (place(first), place(last));
        if first == last { first } else { format!("{first} to {last}") }
    };
    let mut text = runs.iter().map(text).collect::<Vec<_>>().join(", ");
    if more > 0 {
        text.push_str(", and ");
        text.push_str(&more.to_string());
        text.push_str(" more");
    }
    text
}

/// Default rate of pictures of a video. In the turns of the generated hall's walk (60 degrees per second), the chain of
/// pictures broke at four places with 2 Hz, and at none with 3 Hz. [Hz]
const PER_SECOND: f64 = 3.0;
/// Share of an interval from which pictures are selected.
const MIDDLE: f64 = 2.0 / 3.0;
/// Minimum number of pictures per interval for this restriction: with fewer, the middle may contain none.
const SPARSE: f64 = 3.0;
/// Excess over the median blur that texture cannot explain: motion blur of 8 px at a width of 320 px adds 0.09 to 0.16
/// (`blur::tests`).
const BLURRED: f64 = 0.1;
/// Maximum brightness ratio of consecutive pictures on a normal walk.
const JUMP: f64 = 1.6;
/// Maximum number of listed runs.
const MOST_SPANS: usize = 6;

#[cfg(test)]
mod tests {
    use super::super::Picture;
    use super::*;

    fn choice(frames: Option<usize>) -> Choice {
        Choice { frames, width_px: 1920 }
    }

    #[test]
    fn assigns_times_to_intervals() {
        assert_eq!(Buckets::new(50.0, choice(None)).count, 150);
        assert_eq!(Buckets::new(5.0, choice(None)).count, 80);
        assert_eq!(Buckets::new(900.0, choice(None)).count, 300);
        let buckets = Buckets::new(10.0, choice(Some(5)));
        for (at_s, bucket) in [
            (0.0, None),
            (0.5, Some(0)),
            (1.5, Some(0)),
            (1.9, None),
            (2.1, None),
            (3.0, Some(1)),
            (9.5, Some(4)),
            // Beyond the duration in the file.
            (10.9, None),
            (-1.0, None),
        ] {
            assert_eq!(buckets.find(at_s, 30.0), bucket, "at {at_s} s");
        }
        // At 3 Hz, each picture belongs to its own interval.
        let sparse = Buckets::new(50.0, choice(None));
        assert!((0..150).all(|n| sparse.find(f64::from(n) / 3.0 + 1e-9, 3.0) == Some(n as usize)));
    }

    #[test]
    fn remarks_name_the_times_of_blur_and_brightness_jumps() {
        let picture = |number: usize| Picture {
            name: format!("{number}.jpg"),
            at_s: number as f64 * 2.0,
            blur: if (4..=6).contains(&number) { 0.6 } else { 0.3 + 0.001 * number as f64 },
            grey: if number >= 8 { 200.0 } else { 80.0 },
        };
        let mut pictures = Pictures {
            folder: "images".into(),
            size_px: [640, 480],
            of_video: true,
            pictures: (0..12).map(picture).collect(),
        };
        let remarks = super::remarks(&pictures);
        assert!(
            remarks[0].starts_with("3 of 12 pictures are blurred (0:08 to 0:12)"),
            "{remarks:?}"
        );
        assert!(remarks[1].contains("jumps 1 times (0:16)"), "{remarks:?}");
        pictures.of_video = false;
        assert!(super::remarks(&pictures)[1].contains("(8.jpg)"));
        pictures.pictures.truncate(4);
        assert!(super::remarks(&pictures).is_empty());
        pictures.pictures.clear();
        assert!(super::remarks(&pictures).is_empty());
    }
}
