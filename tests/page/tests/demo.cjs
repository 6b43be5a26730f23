// The real flight: the complete program behind a page that starts, watches and stops it. Also: the real server serves
// the same files as the recorded one.

const assert = require("node:assert/strict");
const fs = require("node:fs");
const { isPainted, serverTest, until } = require("../harness.cjs");
const { pageFile, pagePaths } = require("../replay.cjs");

serverTest("demo", async (it) => {
  const report = it.at("report.json");
  const demo = await it.startDemo("--scene", "race", "--plugin", it.plugin("hover", "hover"), "--report", report);
  for (const file of pagePaths()) {
    const answer = await fetch(demo.url + file), { body, headers } = pageFile(file);
    assert.equal(answer.status, 200, file);
    for (const [name, value] of Object.entries(headers)) assert.equal(answer.headers.get(name), value, `${file}: ${name}`);
    assert.ok(Buffer.from(await answer.arrayBuffer()).equals(body), `${file}: another text; rebuild the program`);
  }
  const page = await it.open(demo.url);
  await until(page, "phase-text", /ready to start/);
  await page.locator("#start").click();
  await until(page, "phase-text", /taking off|flying|holding/);
  for (const id of ["colour", "depth"]) await isPainted(page, id);
  await until(page, "clock", /^(?!0:00\.0$)\d/);
  await page.keyboard.press("Escape");
  await until(page, "announcement", /lands/);
  await until(page, "outcome-title", /Stopped by hand/);
  assert.equal(await demo.ended, 1, "a stopped flight is not a success");
  assert.notEqual(JSON.parse(fs.readFileSync(report)).outcome, "finished");
  await it.finish(page);
});
