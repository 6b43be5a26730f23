//! The database in a file, and on a `PostgreSQL` server if `VIZFLYT_TEST_POSTGRES` names one.

use super::grades::tests::grade;
use super::*;

/// Returns an official run that has ended.
pub(crate) fn run(team: &str, stages_passed: u32, seconds: f64) -> Run {
    Run {
        id: format!("{team} {stages_passed} {seconds}"),
        team: Some(team.to_owned()),
        course: "race".to_owned(),
        vehicle: "vizflyt".to_owned(),
        attempt: Attempt::Official,
        state: RunState::Ended,
        began_unix_ms: 0,
        ended_unix_ms: Some(1000),
        outcome: "finished".to_owned(),
        stages_passed,
        stages: 5,
        seconds: Some(seconds),
        penalty_s: 0.0,
        min_clearance_m: Some(0.2),
    }
}

fn new(team: Option<&str>, attempt: Attempt) -> NewRun {
    NewRun {
        team: team.map(str::to_owned),
        course: "race".to_owned(),
        vehicle: "vizflyt".to_owned(),
        attempt,
    }
}

fn end(stages_passed: u32) -> RunEnd {
    RunEnd {
        outcome: "finished".to_owned(),
        stages_passed,
        stages: 5,
        seconds: Some(31.5),
        penalty_s: 2.0,
        min_clearance_m: Some(f64::INFINITY),
        verdict: "{\"score\":1}".to_owned(),
    }
}

async fn file() -> (tempfile::TempDir, Leaderboard) {
    let folder = tempfile::tempdir().unwrap();
    let database = Database::File(folder.path().join("a class?").join("runs 100%.sqlite"));
    (folder, Leaderboard::open(&database).await.unwrap())
}

/// Tests the common behaviour of both databases.
async fn behaves(board: &Leaderboard) {
    let token = board.add_team("wasps").await.unwrap();
    assert_eq!(board.team_of(&token).await.unwrap().as_deref(), Some("wasps"));
    assert_eq!(board.team_of("guessed").await.unwrap(), None);
    let taken = board.add_team("wasps").await.unwrap_err().to_string();
    assert!(taken.contains("there is a team 'wasps' already"), "{taken}");
    for wrong in ["", " x", "a\nb", &"x".repeat(41)] {
        assert!(matches!(board.add_team(wrong).await, Err(LeaderboardError::Name(_))), "{wrong:?}");
    }
    let stranger = board.begin(&new(Some("bees"), Attempt::Practice), None).await.unwrap_err();
    assert_eq!(stranger.to_string(), "there is no team 'bees'; the teams are: wasps");

    let practice = board.begin(&new(Some("wasps"), Attempt::Practice), Some(1)).await.unwrap();
    let official = board.begin(&new(Some("wasps"), Attempt::Official), Some(1)).await.unwrap();
    let spent = board.begin(&new(Some("wasps"), Attempt::Official), Some(1)).await.unwrap_err();
    assert!(spent.to_string().contains("has flown its 1 official attempts on 'race'"), "{spent}");
    let nobody = board.begin(&new(None, Attempt::Practice), None).await.unwrap();
    board.end(&official, &end(4)).await.unwrap();
    board.keep_alive(&practice).await.unwrap();

    let runs = board.runs(Some("race")).await.unwrap();
    let state = |id: &str| runs.iter().find(|run| run.id == id).unwrap();
    assert_eq!(state(&practice).state, RunState::Flying);
    assert_eq!(state(&nobody).team, None);
    let ended = state(&official);
    assert_eq!((ended.state, ended.stages_passed, ended.seconds), (RunState::Ended, 4, Some(31.5)));
    assert_eq!(ended.min_clearance_m, None, "no infinity is kept");
    assert!(board.runs(Some("forest")).await.unwrap().is_empty());
    assert_eq!(board.courses().await.unwrap(), ["race"]);
    assert_eq!(board.verdict(&official).await.unwrap().as_deref(), Some("{\"score\":1}"));
    assert_eq!(board.verdict("none").await.unwrap(), None);
    assert_eq!(standings(&runs, "race", Attempt::Official)[0].seconds, Some(33.5));

    // For two minutes, the flying runs have had no mark.
    board.cut_off_unheard(state(&practice).began_unix_ms + 120_000).await.unwrap();
    let runs = board.runs(None).await.unwrap();
    let cut_off = runs.iter().filter(|run| run.state == RunState::CutOff).count();
    assert_eq!((runs.len(), cut_off), (3, 2));
    board.end(&practice, &end(1)).await.unwrap();

    grades_behave(board).await;

    board.retire_team("wasps").await.unwrap();
    assert_eq!(board.team_of(&token).await.unwrap(), None);
    let teams = board.teams().await.unwrap();
    let retired: Vec<_> = teams.iter().filter(|team| team.retired).map(|team| &team.name).collect();
    assert_eq!(retired, ["wasps"]);
    assert!(board.retire_team("bees").await.is_err());
}

/// Reads and deletes all data of a team; the data of others stay.
async fn erases(board: &Leaderboard) {
    let records = board.records_of("wasps").await.unwrap();
    assert_eq!((records.runs.len(), records.grades.len()), (2, 1));
    assert!(records.runs.iter().any(|run| run.verdict == Some(serde_json::json!({"score": 1}))));
    assert_eq!(records.grades[0].document, "{}");
    let flying = board.begin(&new(Some("wasps"), Attempt::Practice), None).await.unwrap();
    let refused = board.erase_team("wasps").await.unwrap_err().to_string();
    assert!(refused.contains("is flying"), "{refused}");
    assert_eq!(board.records_of("wasps").await.unwrap().grades.len(), 1, "all or nothing");
    board.end(&flying, &end(0)).await.unwrap();
    assert_eq!(board.erase_team("wasps").await.unwrap(), Erased { runs: 3, grades: 1 });
    assert!(board.teams().await.unwrap().iter().all(|team| team.name != "wasps"));
    assert!(board.runs(None).await.unwrap().iter().all(|run| run.team.is_none()));
    assert_eq!(board.grades().await.unwrap().len(), 1);
    for gone in
        [board.erase_team("wasps").await.map(|_| ()), board.records_of("wasps").await.map(|_| ())]
    {
        assert!(gone.unwrap_err().to_string().starts_with("there is no team 'wasps'"));
    }
}

/// The same for grades, with an existing team 'wasps'.
async fn grades_behave(board: &Leaderboard) {
    let own = grade("wasps", 4.25, 7, 31.5);
    board.add_grade(&own, "{}").await.unwrap();
    // The same grade, also under another team's name, and the same flights of another plugin.
    board.add_team("hornets").await.unwrap();
    let taken = GradeEntry { team: "hornets".into(), ..own.clone() };
    for again in [&own, &taken] {
        let error = board.add_grade(again, "{}").await.unwrap_err().to_string();
        assert!(error.contains("already: team 'wasps' has added it"), "{error}");
    }
    let other = GradeEntry { plugin_sha256: "another".into(), median_s: None, ..taken };
    board.add_grade(&other, "{}").await.unwrap();
    let stranger = grade("bees", 1.0, 0, 0.0);
    let error = board.add_grade(&stranger, "{}").await.unwrap_err().to_string();
    assert!(error.starts_with("there is no team 'bees'; the teams are: hornets, wasps"), "{error}");
    assert_eq!(board.grades().await.unwrap(), [own, other]);
}

/// A database without grades keeps its teams and runs, and accepts grades after the migration.
#[tokio::test]
async fn migrates_a_database_of_the_first_version() {
    use sqlx::Connection;
    let folder = tempfile::tempdir().unwrap();
    let database = Database::File(folder.path().join("runs.sqlite"));
    sqlx::any::install_default_drivers();
    let mut first = sqlx::AnyConnection::connect(&database.url()).await.unwrap();
    store::migrations(&store::MIGRATIONS[..1]).run(&mut first).await.unwrap();
    sqlx::query("INSERT INTO teams (name, token_hash, created_unix_ms) VALUES ('wasps', 'x', 1)")
        .execute(&mut first)
        .await
        .unwrap();
    first.close().await.unwrap();
    let board = Leaderboard::open(&database).await.unwrap();
    assert_eq!(board.teams().await.unwrap()[0].name, "wasps");
    grades_behave(&board).await;
}

#[tokio::test]
async fn a_file_stores_teams_and_runs() {
    let (folder, board) = file().await;
    behaves(&board).await;
    let database = board.database().clone();
    drop(board);
    let again = Leaderboard::open(&database).await.unwrap();
    assert_eq!(again.runs(None).await.unwrap().len(), 3);
    erases(&again).await;
    let Database::File(path) = &database else { panic!("a file") };
    for file in std::fs::read_dir(path.parent().unwrap()).unwrap() {
        let bytes = std::fs::read(file.unwrap().path()).unwrap();
        assert!(!bytes.windows(5).any(|word| word == b"wasps"), "a name is left");
    }
    drop(folder);
}

#[tokio::test]
async fn a_postgres_server_behaves_like_a_file() {
    let Ok(url) = std::env::var("VIZFLYT_TEST_POSTGRES") else {
        eprintln!(
            "skipped: VIZFLYT_TEST_POSTGRES names no server; tests/leaderboard/run starts one"
        );
        return;
    };
    let board = Leaderboard::open(&url.parse().unwrap()).await.unwrap();
    behaves(&board).await;
    erases(&board).await;
}

#[cfg(not(feature = "postgres"))]
#[tokio::test]
async fn program_without_postgres_explains_how_to_build_one() {
    let database = "postgres://me:secret@db.example/runs".parse().unwrap();
    let error = Leaderboard::open(&database).await.unwrap_err().to_string();
    assert!(error.contains("--features postgres") && !error.contains("secret"), "{error}");
}

#[tokio::test]
async fn two_programs_share_a_file() {
    let (_folder, board) = file().await;
    let other = Leaderboard::open(board.database()).await.unwrap();
    board.add_team("wasps").await.unwrap();
    // Both begin and end runs at the same time; no run is lost, and no call blocks for ever.
    let fly = |board: Leaderboard| async move {
        for _ in 0..20 {
            let id = board.begin(&new(Some("wasps"), Attempt::Practice), None).await.unwrap();
            board.end(&id, &end(1)).await.unwrap();
        }
    };
    let (one, two) = tokio::join!(tokio::spawn(fly(board.clone())), tokio::spawn(fly(other)));
    one.and(two).unwrap();
    let runs = board.runs(None).await.unwrap();
    assert_eq!(runs.iter().filter(|run| run.state == RunState::Ended).count(), 40);
}

#[tokio::test]
async fn reports_databases_that_cannot_be_opened() {
    let folder = tempfile::tempdir().unwrap();
    let file = folder.path().join("notes.txt");
    std::fs::write(
        &file,
        "these are my notes, and no database at all, although they are long enough",
    )
    .unwrap();
    let error = Leaderboard::open(&Database::File(file.clone())).await.unwrap_err().to_string();
    assert!(error.contains("notes.txt") && error.contains("not a database"), "{error}");
    assert!(std::fs::read_to_string(&file).unwrap().starts_with("these are my notes"));
}
