// Tests of the layout: stored, moved and closed panels; with any stored layout, each panel exists once.
//
//   node --test tests/page/layout.test.cjs

const assert = require("node:assert/strict");
const fs = require("node:fs");
const path = require("node:path");
const test = require("node:test");

const source = fs.readFileSync(path.join(__dirname, "../../render-server/server/src/web/page/layout.js"));
const layout = import(`data:text/javascript;base64,${source.toString("base64")}`);
const usual = { left: ["map", "figures"], right: ["cameras", "events"], closed: [] };

test("panels move up, down and to the other column, and are stored", async () => {
  const { moved, readLayout, toggled } = await layout;
  let now = moved(usual, "events", "up");
  assert.deepEqual(now.right, ["events", "cameras"]);
  assert.equal(moved(now, "events", "up"), now, "nothing is above it");
  now = toggled(moved(now, "cameras", "over"), "figures");
  assert.deepEqual(now, { left: ["map", "figures", "cameras"], right: ["events"], closed: ["figures"] });
  assert.deepEqual(readLayout(usual, JSON.stringify(now)), now);
  assert.deepEqual(toggled(now, "figures").closed, []);
  assert.deepEqual(moved(moved(usual, "map", "down"), "map", "up"), usual);
});

test("panels are put before another, in either column", async () => {
  const { put } = await layout;
  assert.deepEqual(put(usual, "map", "right", "events"), { left: ["figures"], right: ["cameras", "map", "events"], closed: [] });
  assert.deepEqual(put(usual, "map", "left").left, ["figures", "map"]);
  assert.deepEqual(put(usual, "figures", "left", "map").left, ["figures", "map"]);
  assert.equal(put(usual, "map", "left", "map"), usual, "where it is");
  assert.equal(put(usual, "no panel", "left"), usual, "a text from another page was dropped");
  assert.deepEqual(put({ ...usual, closed: ["map"] }, "map", "right").closed, ["map"]);
});

test("any stored layout gives every panel once and no other", async () => {
  const { readLayout } = await layout;
  let seed = 1;
  const random = (most) => {
    seed = (seed * 48_271) % 2_147_483_647;
    return seed % most;
  };
  const words = ["map", "figures", "cameras", "events", "gone", 7, null, {}, ["map"]];
  const some = () => [() => Array.from({ length: random(6) }, () => words[random(words.length)]), () => words[random(words.length)]][random(2)]();
  const texts = [null, "", "{", "null", "[]", "3", '"map"', '{"left":{"length":3}}'];
  for (let k = 0; k < 2000; k += 1) texts.push(JSON.stringify({ left: some(), right: some(), closed: some() }));
  for (const text of texts) {
    const { left, right, closed } = readLayout(usual, text);
    assert.deepEqual([...left, ...right].sort(), ["cameras", "events", "figures", "map"], text);
    assert.ok(closed.every((name) => [...left, ...right].includes(name)) && new Set(closed).size === closed.length, text);
  }
  assert.deepEqual(readLayout(usual, "{"), usual);
});
