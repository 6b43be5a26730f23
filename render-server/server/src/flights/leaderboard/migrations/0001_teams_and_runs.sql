-- Both databases take this. Times are milliseconds since 1970, UTC; what a run lacks is NULL.
CREATE TABLE teams (
    name TEXT PRIMARY KEY,
    -- SHA-256 of its token, hex: the token itself is shown once and kept nowhere.
    token_hash TEXT NOT NULL UNIQUE,
    created_unix_ms BIGINT NOT NULL,
    -- 1: its token opens nothing any more; its runs stay.
    retired BIGINT NOT NULL DEFAULT 0
);

CREATE TABLE runs (
    id TEXT PRIMARY KEY,
    team TEXT REFERENCES teams (name),
    course TEXT NOT NULL,
    vehicle TEXT NOT NULL,
    -- practice | official
    attempt TEXT NOT NULL,
    -- flying | ended | cut_off
    state TEXT NOT NULL,
    began_unix_ms BIGINT NOT NULL,
    -- The server that flies it has said so last.
    heard_unix_ms BIGINT NOT NULL,
    ended_unix_ms BIGINT,
    outcome TEXT,
    stages_passed BIGINT NOT NULL DEFAULT 0,
    stages BIGINT NOT NULL DEFAULT 0,
    seconds DOUBLE PRECISION,
    penalty_s DOUBLE PRECISION NOT NULL DEFAULT 0,
    min_clearance_m DOUBLE PRECISION,
    -- The whole verdict, JSON.
    verdict TEXT
);

CREATE INDEX runs_of_a_course ON runs (course, began_unix_ms);
