use proptest::prelude::*;
use serde_json::Value;

use super::*;

pub(crate) fn subject() -> Subject {
    Subject {
        plugin: "avoid".into(),
        plugin_sha256: "11".repeat(32),
        team: None,
        project: "forest".into(),
        level: "ug".into(),
        variants: vec!["day".into()],
        environments: BTreeMap::new(),
        first_seed: 1,
        points: None,
        seeds: 4,
        courses: None,
        delays: DelaysMs { image_period: 33.3, image: 30.0, answer: 10.0 },
        imu: None,
        program: "0.1.0".into(),
        program_sha256: "22".repeat(32),
        renderer: "cpu avx2".into(),
    }
}

pub(crate) fn run(seed: u64, outcome: OutcomeKind) -> Run {
    Run {
        seed,
        variant: "day".into(),
        outcome,
        reason: "reached the goal".into(),
        cause: (outcome != OutcomeKind::Finished).then(|| "too fast".to_owned()),
        stages_passed: 1,
        stages: vec![StageVerdict { name: "window".into(), passed_s: Some(3.25) }],
        seconds: 10.0 + 0.1 * seed as f64,
        penalty_s: 0.5,
        score: if outcome == OutcomeKind::Finished { 100.0 } else { 50.0 },
        min_clearance_m: Some(0.31),
        max_speed_mps: 2.9,
        path_m: 21.7,
        images: 300,
        odometry: None,
        scene_sha256: "33".repeat(32),
        rules_sha256: "44".repeat(32),
        hash: "55".repeat(32),
    }
}

pub(crate) fn key() -> SigningKey {
    SigningKey::from_bytes(&[7; 32])
}

pub(crate) fn grade() -> Grade {
    let runs = vec![run(3, OutcomeKind::Finished), run(1, OutcomeKind::Collided)];
    let shard = Some(Shard { index: 1, count: 2 });
    let mut grade = Grade::new(subject(), shard, runs);
    let file =
        |path: &str| SignedFile { path: path.to_owned(), bytes: 1000, sha256: "66".repeat(32) };
    grade.files = ["index.html", "logs/day-1.mcap"].map(file).to_vec();
    grade.sign(&key()).unwrap();
    grade
}

#[test]
fn rejects_paths_outside_the_folder() {
    let with = |paths: &[&str]| {
        let mut grade = grade();
        let file = grade.files[0].clone();
        grade.files = paths
            .iter()
            .map(|path| SignedFile { path: (*path).to_owned(), ..file.clone() })
            .collect();
        Grade::parse(&grade.to_text().unwrap())
    };
    assert!(with(&[]).is_ok() && with(&["a", "b/c", "b/d.e"]).is_ok());
    for wrong in ["", "/etc/passwd", "../grade.json", "a/../../b", "a//b", "a/", "./a", "a\0b"] {
        let error = with(&[wrong]).unwrap_err().to_string();
        assert!(error.contains("is not a valid path in a report"), "{wrong}: {error}");
    }
    for wrong in [&["a", "a"][..], &["b", "a"]] {
        assert!(with(wrong).unwrap_err().to_string().contains("sorted by path"));
    }
}

#[test]
fn verifies_a_signed_grade_after_write_and_read() {
    let grade = grade();
    assert_eq!(grade.runs.iter().map(|run| run.seed).collect::<Vec<_>>(), [1, 3]);
    grade.verify(&key().verifying_key()).unwrap();
    let read = Grade::parse(&grade.to_text().unwrap()).unwrap();
    assert_eq!(read, grade);
    read.verify(&key().verifying_key()).unwrap();
    let other = SigningKey::from_bytes(&[8; 32]).verifying_key();
    assert!(read.verify(&other).unwrap_err().to_string().contains("is signed with the key"));
}

/// Returns the paths of all values in a document, except containers.
fn leaves(value: &Value, path: &str, found: &mut Vec<String>) {
    match value {
        Value::Object(fields) => {
            fields.iter().for_each(|(key, v)| leaves(v, &format!("{path}/{key}"), found));
        }
        Value::Array(items) => {
            items.iter().enumerate().for_each(|(i, v)| leaves(v, &format!("{path}/{i}"), found));
        }
        _ => found.push(path.to_owned()),
    }
}

fn is_refused(document: &Value) -> bool {
    let Ok(grade) = Grade::parse(&document.to_string()) else { return true };
    grade.verify(&key().verifying_key()).is_err()
}

#[test]
fn protects_every_field() {
    let document: Value = serde_json::from_str(&grade().to_text().unwrap()).unwrap();
    let mut paths = Vec::new();
    leaves(&document, "", &mut paths);
    assert!(!is_refused(&document) && paths.len() > 60, "{}", paths.len());
    for path in &paths {
        let mut changed = document.clone();
        let value = changed.pointer_mut(path).unwrap();
        *value = match value {
            Value::String(text) if text == "finished" => "collided".into(),
            Value::String(text) if text == "collided" => "finished".into(),
            Value::String(text) => {
                let mut digits = text.clone().into_bytes();
                let last = digits.last_mut().unwrap();
                *last = if *last == b'1' { b'2' } else { b'1' };
                String::from_utf8(digits).unwrap().into()
            }
            Value::Number(number) if number.is_f64() => (number.as_f64().unwrap() + 0.5).into(),
            Value::Number(number) => (number.as_u64().unwrap() + 1).into(),
            other => panic!("{path} holds {other}"),
        };
        assert!(is_refused(&changed), "{path} can be changed");
    }
}

#[test]
fn rejects_missing_and_additional_flights_files_and_fields() {
    let document: Value = serde_json::from_str(&grade().to_text().unwrap()).unwrap();
    let mut fewer = document.clone();
    fewer["runs"].as_array_mut().unwrap().pop();
    assert!(is_refused(&fewer));
    let mut more = document.clone();
    let run = more["runs"][0].clone();
    more["runs"].as_array_mut().unwrap().push(run);
    assert!(is_refused(&more));
    for path in ["", "/subject", "/summary", "/runs/0", "/files/0", "/signature", "/shard"] {
        let mut added = document.clone();
        let place = added.pointer_mut(path).unwrap().as_object_mut().unwrap();
        place.insert("bonus".into(), 1.into());
        assert!(is_refused(&added), "{path:?} accepts an additional field");
    }
    let mut unsigned = document.clone();
    unsigned["files"].as_array_mut().unwrap().pop();
    assert!(is_refused(&unsigned), "a file can be removed");
    for field in ["shard", "files", "signature"] {
        let mut without = document.clone();
        without.as_object_mut().unwrap().remove(field);
        assert!(is_refused(&without), "{field} can be removed");
    }
}

#[test]
fn shards_contain_every_flight_once() {
    let subject = Subject { variants: vec!["day".into(), "night".into()], ..subject() };
    let flights: Vec<_> = subject.flights().collect();
    assert_eq!((flights.len(), flights[0], flights[7]), (8, ("day", 1), ("night", 4)));
    let shards: Vec<Shard> = ["1/3", "2/3", "3/3"].map(|text| text.parse().unwrap()).to_vec();
    for index in 0..flights.len() {
        assert_eq!(shards.iter().filter(|shard| shard.holds(index)).count(), 1);
    }
    for wrong in ["1/100001", "0/3", "4/3", "1/0", "1", "a/b", "-1/2"] {
        assert!(wrong.parse::<Shard>().is_err(), "{wrong}");
    }
}

/// Returns a grade of two variants, one of them random.
fn of_two_variants() -> Grade {
    let drawn = vizflyt_scenes::Variant::drawn(1, 1, &vizflyt_scenes::DrawBounds::default());
    let subject = Subject {
        variants: vec!["day".into(), drawn.to_string()],
        environments: BTreeMap::from([(drawn.to_string(), drawn.environment())]),
        ..subject()
    };
    let by_day = (1..=4).map(|seed| run(seed, OutcomeKind::Finished));
    let drawn = (1..=4).map(|seed| {
        let outcome = if seed == 1 { OutcomeKind::Finished } else { OutcomeKind::Collided };
        Run { variant: drawn.to_string(), ..run(seed, outcome) }
    });
    let mut grade = Grade::new(subject, None, by_day.chain(drawn).collect());
    grade.sign(&key()).unwrap();
    grade
}

#[test]
fn includes_the_results_of_each_variant_and_settings_of_random_ones() {
    let grade = of_two_variants();
    let [day, drawn] = &grade.by_variant[..] else { panic!("two variants") };
    assert_eq!((day.variant.as_str(), day.summary.finished), ("day", 4));
    assert_eq!(
        (drawn.variant.as_str(), drawn.summary.runs, drawn.summary.finished),
        ("random-01", 4, 1)
    );
    assert_eq!((day.summary.score.value, drawn.summary.score.value), (100.0, 62.5));
    let Interval { low, high, .. } = drawn.summary.score;
    assert!((50.0..62.5).contains(&low) && 62.5 < high && high <= 100.0, "{low} {high}");
    // With one variant there are no separate results.
    assert!(Grade::new(subject(), None, vec![run(1, OutcomeKind::Finished)]).by_variant.is_empty());
    // Exact after write and read: the signature is over the text.
    let read = Grade::parse(&grade.to_text().unwrap()).unwrap();
    assert_eq!(read, grade);
    read.verify(&key().verifying_key()).unwrap();
    let mut forged = grade;
    forged.by_variant[1].summary.finished = 4;
    forged.sign(&key()).unwrap();
    let error = forged.verify(&key().verifying_key()).unwrap_err().to_string();
    assert!(error.contains("figures of the variants"), "{error}");
}

#[test]
fn median_is_over_finished_flights() {
    let of = |outcomes: &[OutcomeKind]| {
        let runs = outcomes.iter().zip(1..).map(|(&outcome, seed)| run(seed, outcome));
        Grade::new(subject(), None, runs.collect()).median_finish_s()
    };
    // Seed n takes 10.5 s plus n tenths, penalty included.
    let (done, hit) = (OutcomeKind::Finished, OutcomeKind::Collided);
    assert_eq!(of(&[hit, hit]), None);
    assert_eq!(of(&[hit, done]), Some(10.7));
    assert_eq!(of(&[done, done, hit, done]), Some(10.7));
    assert_eq!(of(&[done, done]), Some(10.65));
}

#[test]
fn rejects_numbers_above_the_maximum() {
    let parsed = |change: &dyn Fn(&mut Grade)| {
        let mut grade = grade();
        change(&mut grade);
        Grade::parse(&grade.to_text().unwrap())
    };
    assert!(parsed(&|_| ()).is_ok());
    for wrong in [Shard { index: 1, count: u64::MAX }, Shard { index: 0, count: 0 }] {
        let error = parsed(&|grade| grade.shard = Some(wrong)).unwrap_err().to_string();
        assert!(error.ends_with("is not a valid shard"), "{error}");
    }
    let error = parsed(&|grade| grade.subject.seeds = u64::MAX).unwrap_err().to_string();
    assert!(error.contains("at most 100000"), "{error}");
    assert!(parsed(&|grade| grade.subject.variants = vec!["day".into(); 65]).is_err());
}

#[test]
fn parses_hexadecimal_and_rejects_other_text() {
    assert_eq!(from_hex::<2>(&hex(&[0xab, 0x01])), Some([0xab, 0x01]));
    for text in ["", "abc", "abcg", "+bcd", "äb", "AB01"] {
        assert_eq!(from_hex::<2>(text), None, "{text}");
    }
}

proptest! {
    #[test]
    fn detects_any_changed_byte(at in 0usize..4000, byte in 32u8..127) {
        let text = grade().to_text().unwrap();
        let mut bytes = text.clone().into_bytes();
        let at = at % bytes.len();
        bytes[at] = byte;
        let changed = String::from_utf8(bytes).unwrap();
        let same = |text: &str| serde_json::from_str::<Value>(text).ok();
        // Other spaces, or another notation of the same number, are not a change.
        prop_assume!(same(&changed) != same(&text));
        let refused = Grade::parse(&changed)
            .is_ok_and(|grade| grade == super::tests::grade())
            || Grade::parse(&changed)
                .map_or(true, |grade| grade.verify(&key().verifying_key()).is_err());
        prop_assert!(refused);
    }
}
