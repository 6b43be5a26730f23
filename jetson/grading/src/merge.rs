//! Combines the shards of a grade.

use anyhow::{Context, Result, bail, ensure};
use ed25519_dalek::VerifyingKey;

use super::document::{Grade, Run};

/// Returns the unsigned grade of all shards. Each must be signed with `key`, all must have the same
/// subject, and every shard must occur once.
///
/// # Errors
/// The first mismatch, as a sentence.
pub fn merge(parts: &[(String, Grade)], key: &VerifyingKey) -> Result<Grade> {
    let Some((first_name, first)) = parts.first() else { bail!("there is nothing to merge") };
    let mut there = Vec::new();
    let mut runs: Vec<Run> = Vec::new();
    for (name, part) in parts {
        part.verify(key).with_context(|| format!("{name} is not valid"))?;
        ensure!(
            part.subject.courses == first.subject.courses,
            "{name} and {first_name} were flown on other courses: give every shard the same --secret FILE"
        );
        ensure!(
            part.subject == first.subject,
            "{name} and {first_name} are grades of different subjects: plugin, team, program, project, \
             level, variants, seeds, delays and renderer must be the same"
        );
        let shard =
            part.shard.with_context(|| format!("{name} is a complete grade, not a shard"))?;
        let count = first.shard.map_or(0, |shard| shard.count);
        ensure!(shard.count == count, "{name} is part of {}, {first_name} of {count}", shard.count);
        ensure!(!there.contains(&shard.index), "part {} is given twice", shard.index);
        there.push(shard.index);
        runs.extend(part.runs.iter().cloned());
    }
    let count = first.shard.map_or(0, |shard| shard.count);
    let missing: Vec<String> =
        (1..=count).filter(|index| !there.contains(index)).map(|index| index.to_string()).collect();
    ensure!(missing.is_empty(), "missing parts of {count}: {}", missing.join(", "));
    let subject = first.subject.clone();
    let expected: Vec<(&str, u64)> = subject.flights().collect();
    let grade = Grade::new(subject.clone(), None, runs);
    let found: Vec<(&str, u64)> =
        grade.runs.iter().map(|run| (run.variant.as_str(), run.seed)).collect();
    ensure!(found == expected, "the parts do not contain every flight once");
    Ok(grade)
}

#[cfg(test)]
mod tests {
    use vizflyt_protocol::messages::OutcomeKind;

    use super::super::document::Subject;
    use super::super::document::tests::{key, run, subject};
    use super::*;
    use vizflyt_studio::shard::Shard;

    fn part(subject: &Subject, index: u64, count: u64, seeds: &[u64]) -> (String, Grade) {
        let runs = seeds.iter().map(|&seed| run(seed, OutcomeKind::Finished)).collect();
        let mut grade = Grade::new(subject.clone(), Some(Shard { index, count }), runs);
        grade.sign(&key()).unwrap();
        (format!("part-{index}.json"), grade)
    }

    fn refused(parts: &[(String, Grade)], word: &str) {
        let error = format!("{:#}", merge(parts, &key().verifying_key()).unwrap_err());
        assert!(error.contains(word), "{word:?} is missing in {error:?}");
    }

    #[test]
    fn combines_shards_in_any_order() {
        let subject = subject();
        let parts = [part(&subject, 2, 2, &[2, 4]), part(&subject, 1, 2, &[3, 1])];
        let merged = merge(&parts, &key().verifying_key()).unwrap();
        let whole = (1..=4).map(|seed| run(seed, OutcomeKind::Finished)).collect();
        assert_eq!(merged, Grade::new(subject, None, whole));
    }

    #[test]
    fn rejects_shards_that_do_not_match() {
        let subject = subject();
        let (one, two) = (part(&subject, 1, 2, &[1, 3]), part(&subject, 2, 2, &[2, 4]));
        refused(&[], "nothing");
        refused(std::slice::from_ref(&one), "missing parts of 2: 2");
        refused(&[one.clone(), one.clone(), two.clone()], "twice");
        refused(&[one.clone(), part(&subject, 2, 3, &[2, 4])], "is part of 3");
        refused(&[one.clone(), part(&subject, 2, 2, &[2, 5])], "every flight once");
        let other = Subject { plugin_sha256: "00".repeat(32), ..subject.clone() };
        refused(&[one.clone(), part(&other, 2, 2, &[2, 4])], "different subjects");
        let other = Subject { courses: Some("77".repeat(16)), ..subject.clone() };
        refused(&[one.clone(), part(&other, 2, 2, &[2, 4])], "the same --secret FILE");
        let mut forged = two.clone();
        forged.1.runs[0].score = 0.0;
        refused(&[one.clone(), forged], "part-2.json is not valid");
        let mut whole = two;
        whole.1.shard = None;
        whole.1.sign(&key()).unwrap();
        refused(&[one, whole], "not a shard");
    }
}
