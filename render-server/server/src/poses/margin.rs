//! Warning about sources whose latency or rate leaves no margin for the limits of `[pose]`. Sans-IO, called ten
//! times a second.

use vizflyt_arena::pose::{MAX_SOURCES, SourceQuality};
use vizflyt_protocol::messages::{MAX_ALLOWANCE_S, PoseAges};
use vizflyt_protocol::time::ServerTime;

/// Margins of the sources of one vehicle.
#[derive(Clone, Copy, Debug, Default)]
pub(super) struct MarginWatch {
    sources: [Watched; MAX_SOURCES],
}

#[derive(Clone, Copy, Debug, Default)]
struct Watched {
    /// Start of the present period without a pause.
    since: Option<ServerTime>,
    judged: bool,
}

impl MarginWatch {
    /// Checks a source; returns a warning once, when its rate has settled.
    pub(super) fn judge(
        &mut self,
        now: ServerTime,
        source: &SourceQuality,
        ages: &PoseAges,
    ) -> Option<String> {
        let watched = self.sources.get_mut(usize::from(source.source))?;
        if source.rate_hz == 0.0 {
            watched.since = None;
        }
        if watched.judged || source.rate_hz == 0.0 {
            return None;
        }
        let since = *watched.since.get_or_insert(now);
        if now.seconds_since(since) < SETTLED_S {
            return None;
        }
        watched.judged = true;
        no_margin(source, ages)
    }
}

/// Returns a warning if the vehicle would hold after at most one lost pose, because the allowance for delay and
/// rate is not sufficient.
fn no_margin(source: &SourceQuality, ages: &PoseAges) -> Option<String> {
    let PoseAges { hold_after_s, land_after_s } = *ages;
    let (latency_s, interval_s) = (source.latency_ms * 1e-3, 1.0 / source.rate_hz);
    let allowed_s = ages.allowance_s(latency_s, interval_s);
    let holds = match hold_after_s + allowed_s {
        hold if latency_s + interval_s > hold => "the vehicle will hold again and again",
        hold if latency_s + 2.0 * interval_s > hold => "the vehicle will hold at each lost pose",
        _ => return None,
    };
    // One lost pose and one late pose, with the full allowance.
    let most_s = f64::from(MAX_ALLOWANCE_S);
    let enough_s = latency_s + 3.0 * interval_s - latency_s.min(most_s);
    let enough_s = (enough_s * 100.0 - ROUNDED).ceil() / 100.0;
    let land = if enough_s < land_after_s {
        String::new()
    } else {
        format!(" (and land_after_s = {land_after_s} above that)")
    };
    Some(format!(
        "source {}: {:.0} ms latency at {:.0} Hz leaves no margin before [pose] hold_after_s = {hold_after_s}: \
         raise it to at least {enough_s:.2}{land}, or {holds}",
        source.name, source.latency_ms, source.rate_hz
    ))
}

/// Time until a rate has settled. [s]
const SETTLED_S: f64 = 4.0;
/// Fraction of a hundredth of a second that is not rounded up.
const ROUNDED: f64 = 0.2;

#[cfg(test)]
mod tests {
    use super::*;

    const AGES: PoseAges = PoseAges { hold_after_s: 0.15, land_after_s: 0.5 };

    fn source(latency_ms: f64, rate_hz: f64) -> SourceQuality {
        SourceQuality { name: "vicon".into(), latency_ms, rate_hz, ..SourceQuality::default() }
    }

    fn check(latency_ms: f64, rate_hz: f64, expected: Option<&str>) {
        let found = no_margin(&source(latency_ms, rate_hz), &AGES);
        match (found.as_deref(), expected) {
            (Some(found), Some(expected)) => assert!(found.contains(expected), "{found}"),
            (found, expected) => assert_eq!(found, expected, "{latency_ms} ms at {rate_hz} Hz"),
        }
    }

    #[test]
    fn warns_of_late_or_rare_poses() {
        assert_eq!(
            no_margin(&source(420.0, 20.0), &AGES).unwrap(),
            "source vicon: 420 ms latency at 20 Hz leaves no margin before [pose] hold_after_s = 0.15: raise it \
             to at least 0.27, or the vehicle will hold again and again"
        );
        check(360.0, 20.0, Some("at least 0.21, or the vehicle will hold at each lost pose"));
        check(650.0, 10.0, Some("at least 0.65 (and land_after_s = 0.5 above that)"));
        check(5.0, 4.0, Some("5 ms latency at 4 Hz"));
        // The allowance is sufficient.
        for (latency_ms, rate_hz) in [(5.0, 200.0), (120.0, 20.0), (300.0, 20.0), (2.0, 10.0)] {
            check(latency_ms, rate_hz, None);
        }
    }

    #[test]
    fn warns_once_per_source_when_its_rate_has_settled() {
        let mut watch = MarginWatch::default();
        let at = |seconds: f64| ServerTime::ZERO.plus_seconds(seconds);
        let late = source(420.0, 20.0);
        assert_eq!(watch.judge(at(1.0), &late, &AGES), None);
        // After a pause, the time starts again.
        assert_eq!(watch.judge(at(3.0), &source(0.0, 0.0), &AGES), None);
        assert_eq!(watch.judge(at(5.5), &late, &AGES), None);
        assert_eq!(watch.judge(at(9.0), &late, &AGES), None);
        assert!(watch.judge(at(9.6), &late, &AGES).is_some());
        assert_eq!(watch.judge(at(20.0), &late, &AGES), None);
        // Another one.
        let other = SourceQuality { source: 1, ..late };
        assert_eq!(watch.judge(at(20.0), &other, &AGES), None);
        assert!(watch.judge(at(25.0), &other, &AGES).is_some());
    }
}
