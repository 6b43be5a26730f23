// Tests of the wall's ghost: the best official run that this screen has recorded from take-off.
//
//   node --test tests/page/best_run.test.cjs

const assert = require("node:assert/strict");
const fs = require("node:fs");
const path = require("node:path");
const test = require("node:test");

const source = fs.readFileSync(path.join(__dirname, "../../render-server/server/src/web/page/best_run.js"));
const best = import(`data:text/javascript;base64,${source.toString("base64")}`);
const run = (id, state) => ({ id, state, vehicle: "bee" });
const board = (newest, leader, flight_s) => ({
  newest, official: leader ? [{ run: leader, team: "wasps" }] : [], vehicles: [{ vehicle: "bee", flight_s }],
});
const fly = (all, from_s, to_s) => {
  for (let t_s = from_s; t_s <= to_s; t_s += 0.05) all.watch("bee", t_s, [t_s, 0, 1]);
};

test("the best run is the ghost of later runs, also after a restart", async () => {
  const { BestRun, ghostAt, readGhost } = await best;
  const all = new BestRun(null);
  all.watch("bee", null, [0, 0, 0]);
  fly(all, 0, 5);
  assert.equal(all.take(board([run("1", "flying")], null, 5)), false);
  assert.equal(all.take(board([run("1", "ended")], "1", null)), true);
  assert.ok(all.ghost.moments.length > 40 && all.ghost.moments.length < 60, `${all.ghost.moments.length}`);
  const kept = readGhost(JSON.stringify(all.ghost));
  assert.deepEqual(kept, all.ghost);
  const again = new BestRun(kept);
  assert.equal(again.take(board([], "1", null)), false);
  assert.ok(Math.abs(ghostAt(again.ghost, 2.03).p_world_m[0] - 2.03) < 1e-6);
  again.take(board([], "2", null));
  assert.equal(again.ghost, null, "another run is best, without a recorded path");
});

test("an incomplete recording or another vehicle's flight is not a ghost", async () => {
  const { BestRun } = await best;
  const late = new BestRun(null);
  fly(late, 3, 5);
  late.take(board([run("1", "flying")], null, 5));
  assert.equal(late.take(board([run("1", "ended")], "1", null)), false);
  const former = new BestRun(null);
  fly(former, 0, 5);
  former.take(board([run("2", "flying")], null, 40));
  assert.equal(former.take(board([run("2", "ended")], "2", null)), false, "what was watched is not of this run");
  assert.equal(former.ghost, null);
});

test("invalid stored ghosts are ignored", async () => {
  const { readGhost, ghostAt } = await best;
  for (const text of [null, "", "{", "null", "[]", '{"run":1,"team":"a","moments":[]}', '{"run":"1","team":"a","moments":[[1,2,3]]}',
    '{"run":"1","team":"a","moments":[[1,2,3,null]]}', '{"run":"1","team":"a","moments":3}'])
    assert.equal(readGhost(text), null, `${text}`);
  assert.equal(ghostAt({ run: "1", team: "a", moments: [] }, 1), null);
});
