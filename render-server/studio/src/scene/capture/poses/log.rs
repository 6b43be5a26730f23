//! Parser for the output of COLMAP and pycolmap.

/// Progress of a tool.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Phase {
    /// Number of pictures with extracted features.
    Features { done: usize, of: usize },
    /// Current block of pairs, from 1.
    Matching { done: usize, of: usize },
    /// Number of placed pictures.
    Placing { done: usize },
}

/// Returns the progress from a line of COLMAP 3.8 to 4.2; `None` for other lines.
pub(super) fn phase(line: &str) -> Option<Phase> {
    if let Some(rest) = after(line, "Processed file [") {
        let [done, of] = share(rest)?;
        return Some(Phase::Features { done, of });
    }
    if let Some(rest) =
        after(line, "Matching block [").or_else(|| after(line, "Processing block ["))
    {
        let [done, of] = share(rest)?;
        return Some(Phase::Matching { done, of });
    }
    let rest = after(line, "Registering image #")?;
    let (_, rest) = rest.split_once('(')?;
    let digits = rest.trim_start_matches("num_reg_frames=");
    Some(Phase::Placing { done: leading(digits)? })
}

/// Returns the text of the last line with an error; without one, the last line that is not empty.
pub(super) fn error(log: &str) -> Option<&str> {
    let is_error = |line: &&str| {
        let glog = line.starts_with('E') || line.starts_with('F');
        let glog = glog && line[1..].starts_with(|c: char| c.is_ascii_digit());
        glog || line.contains("Error") || line.contains("ERROR")
    };
    let line = log
        .lines()
        .rev()
        .find(is_error)
        .or_else(|| log.lines().rev().find(|line| !line.trim().is_empty()))?;
    // "E20261123 23:16:54.7 1405 feature.cc:445] text"
    Some(line.split_once("] ").map_or(line, |(_, text)| text).trim())
}

fn after<'a>(line: &'a str, mark: &str) -> Option<&'a str> {
    line.split_once(mark).map(|(_, rest)| rest)
}

/// Parses "3/100" or "1/2, 1/2", of which the first part counts.
fn share(text: &str) -> Option<[usize; 2]> {
    let (done, rest) = text.split_once('/')?;
    Some([done.trim().parse().ok()?, leading(rest)?])
}

fn leading(text: &str) -> Option<usize> {
    let end = text.find(|c: char| !c.is_ascii_digit()).unwrap_or(text.len());
    text[..end].parse().ok()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn parses_progress_of_both_tools() {
        let head = "I20261123 23:16:54.711333 140452787373760 feature_extraction.cc:270] ";
        for (line, expected) in [
            ("Processed file [3/100]", Some(Phase::Features { done: 3, of: 100 })),
            ("Processing block [2/4, 1/4]", Some(Phase::Matching { done: 2, of: 4 })),
            ("Processing block [7/9]", Some(Phase::Matching { done: 7, of: 9 })),
            // COLMAP 3.8.
            ("Matching block [1/4] in 3.2s", Some(Phase::Matching { done: 1, of: 4 })),
            ("Registering image #12 (num_reg_frames=34)", Some(Phase::Placing { done: 34 })),
            ("Registering image #12 (34)", Some(Phase::Placing { done: 34 })),
            ("Registering initial image pair #1 and #2", None),
            ("Processed file [3/x]", None),
            ("Processed file [", None),
            ("Registering image #12", None),
            ("", None),
        ] {
            assert_eq!(phase(line), expected, "{line}");
            assert_eq!(phase(&format!("{head}{line}")), expected, "{line}");
        }
    }

    #[test]
    fn finds_the_last_error() {
        let log =
            "I2026 1 a.cc:1] fine\nE2026 2 b.cc:2] Cannot open the database\nI2026 3 c.cc:3] bye\n";
        assert_eq!(error(log), Some("Cannot open the database"));
        assert_eq!(error("what\nis this\n\n"), Some("is this"));
        assert_eq!(error(""), None);
        let trace = "Traceback (most recent call last):\n  File \"x\"\nModuleNotFoundError: No module named 'pycolmap'\n";
        assert_eq!(error(trace), Some("ModuleNotFoundError: No module named 'pycolmap'"));
    }
}
