-- Signed grades of `vizflyt grade`, as they were added; the signature was verified then.
CREATE TABLE grades (
    -- Over all flights, as the grade has it; with the plugin's, the same grade is not added twice.
    hash TEXT NOT NULL,
    plugin_sha256 TEXT NOT NULL,
    team TEXT NOT NULL REFERENCES teams (name),
    project TEXT NOT NULL,
    level TEXT NOT NULL,
    -- Variants, seeds and delays in words: only grades of the same can be compared.
    conditions TEXT NOT NULL,
    added_unix_ms BIGINT NOT NULL,
    flights BIGINT NOT NULL,
    finished BIGINT NOT NULL,
    stages BIGINT NOT NULL,
    mean_stages_passed DOUBLE PRECISION NOT NULL,
    -- Of the flights that finished, penalties added.
    median_s DOUBLE PRECISION,
    score DOUBLE PRECISION NOT NULL,
    -- The whole grade, JSON, with its signature.
    document TEXT NOT NULL,
    PRIMARY KEY (hash, plugin_sha256)
);
