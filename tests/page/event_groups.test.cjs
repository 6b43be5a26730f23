// Tests of grouping: repeated events are one line with a count.
//
//   node --test tests/page/event_groups.test.cjs

const assert = require("node:assert/strict");
const fs = require("node:fs");
const path = require("node:path");
const test = require("node:test");

const source = fs.readFileSync(path.join(__dirname, "../../render-server/server/src/web/page/event_groups.js"));
const groups = import(`data:text/javascript;base64,${source.toString("base64")}`);

test("equal events are one line, even with others in between; different events are not", async () => {
  const { EventGroups } = await groups;
  const all = new EventGroups();
  const first = all.add("bad", "pose lost", 1);
  all.add("good", "pose is back", 2);
  const again = all.add("bad", "pose lost", 3);
  assert.equal(again, first);
  assert.deepEqual([again.count, again.first_s, again.at_s], [2, 1, 3]);
  assert.notEqual(all.add("good", "gate 1", 4), all.add("good", "gate 2", 5));
  assert.notEqual(all.add("", "gate 1", 6), all.add("good", "gate 1", 7), "another colour");
});

test("events with a count of the runtime are equal despite other numbers", async () => {
  const { EventGroups } = await groups;
  const all = new EventGroups();
  const first = all.add("warn", "an answer took 72 ms of 60 ms (1 so far)", 1);
  assert.equal(all.add("warn", "an answer took 95 ms of 60 ms (2 so far)", 2), first);
  assert.notEqual(all.add("warn", "a packet is refused (2 so far)", 3), first);
});

test("a line that is followed by many others keeps its place", async () => {
  const { EventGroups } = await groups;
  const all = new EventGroups();
  const first = all.add("", "takes off", 0);
  for (let k = 0; k < 8; k += 1) all.add("", `something else ${k}`, k);
  const later = all.add("", "takes off", 9);
  assert.notEqual(later, first);
  assert.deepEqual([first.count, later.count], [1, 1]);
  assert.ok(all.newest.length <= 8);
});
