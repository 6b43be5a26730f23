// Tests of the stages that a flight has passed, by the events of the server.
//
//   node --test tests/page/event_kinds.test.cjs

const assert = require("node:assert/strict");
const fs = require("node:fs");
const path = require("node:path");
const test = require("node:test");

const source = fs.readFileSync(path.join(__dirname, "../../render-server/server/src/web/page/event_kinds.js"));
const kinds = import(`data:text/javascript;base64,${source.toString("base64")}`);

test("stages of an earlier flight are dropped at the next take-off", async () => {
  const { notePassed } = await kinds;
  const stage = (index) => ({ kind: { stage: { index, name: "gate" } } });
  const passed = new Set();
  notePassed(passed, [{ kind: { phase: "taking_off" } }, stage(0), stage(1), { kind: "note" }, { kind: { phase: "landed" } }]);
  assert.deepEqual([...passed], [0, 1]);
  notePassed(passed, [{ kind: { phase: "taking_off" } }, { kind: { phase: "flying" } }, stage(0)]);
  assert.deepEqual([...passed], [0]);
});
