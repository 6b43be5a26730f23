// Tests of the recordings that the tests of the page replay: each message and answer has the type that the server sends
// today, by `messages.d.ts`, which a test of the server generates. An outdated recording must be recorded again.
//
//   node --test tests/page/recordings.test.cjs

const assert = require("node:assert/strict");
const { spawnSync } = require("node:child_process");
const fs = require("node:fs");
const path = require("node:path");
const { test } = require("node:test");

const root = path.join(__dirname, "../..");
const folder = path.join(__dirname, "recordings");
/** Maximum size of all recordings, because they are in every clone. [bytes] */
const MAX_TOTAL = 1_200_000;
/** Types of answers by path, as in `messages.d.ts`. */
const ANSWERS = [
  [/^\/api\/session$/, "Session"], [/^\/api\/vehicles$/, "VehicleLine[]"], [/^\/api\/vehicles\/[^/]+\/crash$/, "CrashCard"],
  [/^\/api\/vehicles\/[^/]+\/sensors$/, "SensorLine[]"], [/^\/api\/scenes$/, "SceneChoice"], [/^\/api\/environment$/, "Environment"],
  [/^\/api\/pairing$/, "Pairing"], [/^\/api\/lab$/, "LabDay"], [/^\/api\/leaderboard$/, "Leaderboard"], [/^\/api\/stats$/, "Stats"],
];
/** Types of messages by their tag. */
const MESSAGES = { arena: "Arena", cameras: "Cameras", track: "Track", events: "Events", state: "State" };

/** Returns the shape of a value; most states have the same. */
function shape(value) {
  if (value === null || typeof value !== "object") return value === null ? "null" : typeof value;
  if (Array.isArray(value)) return `[${[...new Set(value.map(shape))].sort()} ${Math.min(value.length, 5)}]`;
  return `{${Object.entries(value).map(([key, one]) => `${key}: ${shape(one)}`).sort()}}`;
}

/** Returns the type and value of a record's JSON; null without JSON. */
function typed({ message, get, json }) {
  if (message) return [MESSAGES[message.type], message];
  if (!get || json === undefined) return null;
  const [, type] = ANSWERS.find(([pattern]) => pattern.test(get.split("?")[0])) ?? [];
  return [type, json];
}

test("recordings match the current types of messages", () => {
  const target = path.join(root, "target/page/recorded");
  fs.mkdirSync(target, { recursive: true });
  const types = path.relative(target, path.join(root, "render-server/server/src/web/page/messages"));
  const lines = [`import type * as Messages from "./${types}";`], seen = new Set();
  for (const file of fs.readdirSync(folder).sort()) {
    const [about, ...records] = fs.readFileSync(path.join(folder, file), "utf8").trimEnd().split("\n").map((line) => JSON.parse(line));
    assert.equal(about.anew, `tests/page/run --record --only ${path.basename(file, ".jsonl")} VIZFLYT`, file);
    records.forEach((record, k) => {
      const [type, value] = typed(record) ?? [];
      if (value === undefined) return;
      assert.ok(type, `${file}:${k + 2} is of no known type: ${JSON.stringify(record).slice(0, 100)}`);
      const key = `${type} ${shape(value)}`;
      if (!seen.has(key)) lines.push(`export const a${seen.size}: Messages.${type} = ${JSON.stringify(value)}; // ${file}:${k + 2}`);
      seen.add(key);
    });
  }
  assert.ok(seen.size > 20, `${seen.size} kinds of messages`);
  fs.writeFileSync(path.join(target, "recorded.ts"), `${lines.join("\n")}\n`);
  const options = { strict: true, noEmit: true, target: "es2024", module: "esnext", moduleResolution: "bundler", types: [] };
  fs.writeFileSync(path.join(target, "tsconfig.json"), JSON.stringify({ compilerOptions: options, include: ["recorded.ts"] }));
  const { status, stdout } = spawnSync(path.join(root, "target/page/node_modules/.bin/tsc"), ["--project", target], { encoding: "utf8" });
  // Report only the places of type errors: the lines are long.
  const faults = stdout.split("\n").filter(Boolean).slice(0, 10).map((fault) => {
    const line = fault.match(/recorded\.ts\((\d+),/)?.[1];
    return `${line ? lines[line - 1].match(/\/\/ (\S+)$/)?.[1] : ""} ${fault}`.slice(0, 400);
  });
  assert.equal(status, 0, `the recordings do not match the current server; record them again (tests/page/run --record):\n${faults.join("\n")}`);
});

test("recordings stay small", () => {
  const total = fs.readdirSync(folder).reduce((sum, file) => sum + fs.statSync(path.join(folder, file)).size, 0);
  assert.ok(total < MAX_TOTAL, `${total} bytes`);
});
