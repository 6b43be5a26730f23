// A course is set up in a room by hand: a gate is added, dragged, checked and saved; comments are kept, and the course
// can be flown.

const assert = require("node:assert/strict");
const fs = require("node:fs");
const path = require("node:path");
const { checkBarriers, serverTest, until } = require("../harness.cjs");

serverTest("course", async (it) => {
  const folder = it.at("course");
  it.command("scene", "generate", "room", "--seed", "3", "-o", folder);
  const file = path.join(folder, "arena.toml");
  fs.writeFileSync(file, `# For Tuesday.\n${fs.readFileSync(file, "utf8")}`);
  const server = it.start("arena", "edit", folder, "--no-browser", "--renderer", "cpu");
  const [, url] = await server.line(/^page\s+(http\S+)/);
  const page = await it.open(url);
  const press = (name) => page.getByRole("button", { name, exact: true }).click();
  const value = async (label) => +(await page.getByLabel(label, { exact: true }).inputValue());
  await until(page, "course-verdict", /^can be flown: 0 gates/);
  assert.ok(await page.locator("#course-save").isDisabled(), "nothing has changed");
  await press("gate");
  await until(page, "course-verdict", /^can be flown: 1 gate, a way of [\d.]+ m · 0\.\d+ m of room/);
  // The frame is in the image: orange and white around the opening.
  await page.waitForFunction(() => {
    const canvas = document.getElementById("picture");
    const { data } = canvas.getContext("2d").getImageData(0, 0, canvas.width, canvas.height);
    let count = 0;
    for (let k = 0; k < data.length; k += 4) count += data[k] > 170 && data[k + 1] < 110 && data[k + 2] < 60;
    return (count * 4) / data.length > 0.002;
  }, null, { polling: 200 });
  await it.shot(page, "course-gate");
  await checkBarriers(page, "the editor of courses");
  const [x, width] = [await value("middle x"), await value("width")];
  // At the height of the camera, the handle of the width is to the right of the centre; the image is 75 degrees wide.
  const px = (metres) => (metres / (x - 0.9)) * (720 / Math.tan((37.5 * Math.PI) / 180));
  await page.mouse.move(720 + px(width / 2), 450);
  await page.mouse.down();
  await page.mouse.move(720 + px(width / 2 + 0.15), 450, { steps: 6 });
  await page.mouse.up();
  await until(page, "course-verdict", /^can be flown/);
  assert.equal(await value("width"), 1.5);
  await press("pillar");
  await until(page, "course-findings", /gate 1.*touches 'pillar 1'/);
  await until(page, "course-verdict", /^cannot be flown: 1 found/);
  await press("undo");
  await until(page, "course-verdict", /^can be flown/);
  await page.locator("#course-save").click();
  await until(page, "course-saved", /written .*arena.toml · models 1 new/);
  await it.shot(page, "course-saved");
  const written = fs.readFileSync(file, "utf8");
  assert.ok(written.startsWith("# For Tuesday.\n"), written);
  assert.match(written, /\[\[stages\]\]\nname = "gate 1"[\s\S]*width_m = 1.5[\s\S]*scene = "models\/gate-150x100-orange.ply"/);
  assert.match(it.command("arena", "check", folder), /can be flown; 1 stages/);
  const foreign = await fetch(`${url}/api/course`, { method: "POST", body: '"open"', headers: { origin: "http://evil.example" } });
  assert.equal(foreign.status, 403);
  await it.finish(page);
  server.child.kill("SIGTERM");
  assert.equal(await server.ended, 0);
});

/** A first-time user adds a gate, using only visible elements. */
serverTest("place_gate", async (it) => {
  it.command("scene", "generate", "room", "--seed", "3", "-o", it.at("room"));
  const editor = it.start("arena", "edit", it.at("room"), "--no-browser", "--renderer", "cpu");
  const [, url] = await editor.line(/^page\s+(http\S+)/);
  const page = await it.open(url);
  await page.getByText(/can be flown: 0 gates/).waitFor();
  await page.getByRole("button", { name: "gate", exact: true }).click();
  await page.getByText(/can be flown: 1 gate/).waitFor();
  await it.finish(page);
  editor.child.kill("SIGTERM");
  assert.equal(await editor.ended, 0);
});
