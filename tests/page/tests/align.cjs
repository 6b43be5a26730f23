// A captured scene, tilted by 5 degrees and a tenth too small, is aligned to its room by clicks, and its placement is
// saved.

const assert = require("node:assert/strict");
const fs = require("node:fs");
const { checkBarriers, serverTest, text, until } = require("../harness.cjs");

serverTest("align", async (it) => {
  it.command("scene", "generate", "room", "--seed", "3", "-o", it.at("room"));
  const file = it.at("room/arena.toml");
  const place = 'scene = { file = "scene.ply", rotation = [0.0436, 0, 0, 0.99905], metres_per_unit = 0.9 }';
  // Without the course, which does not move when fence and start move.
  const room = fs.readFileSync(file, "utf8").replace(/\[(goal|rules(\.\w+)?)\][^[]*(\[[\d -][^[]*)*/g, "");
  fs.writeFileSync(file, `# Captured by hand.\n${room.replace(/^scene = .*$/m, place)}`);
  const server = it.start("scene", "align", it.at("room"), "--no-browser", "--renderer", "cpu");
  const [, url] = await server.line(/page\s+(http:\S+)/);
  const page = await it.open(url);
  // The panel loads after the first image, as on a busy computer, and must accept that image.
  await page.route("**/align.js", async (route) => {
    await page.waitForFunction(() => document.body.dataset.pictures > 0);
    await route.continue();
  });
  // Counts pending requests: each answer redraws the panel, which would lose a pressed button.
  await page.addInitScript(() => {
    const { fetch } = globalThis;
    globalThis.waiting = 0;
    globalThis.fetch = async (...request) => {
      if (request[1]?.method !== "POST") return fetch(...request);
      globalThis.waiting += 1;
      const answer = await fetch(...request), text = answer.text.bind(answer);
      // As a separate task, so that the page processes the text first.
      answer.text = () => text().finally(() => setTimeout(() => (globalThis.waiting -= 1)));
      return answer;
    };
  });
  await page.reload();
  const settled = () => page.waitForFunction(() => globalThis.waiting === 0);
  const press = async (name) => {
    await settled();
    await page.getByRole("button", { name, exact: true }).click();
  };
  /** Clicks into an image of the current camera; returns the server's answer. */
  const pick = async (x, y) => {
    const answer = page.waitForResponse((response) => response.url().endsWith("/pick"));
    await page.mouse.click(x, y);
    const { p_scene, ...rest } = await (await answer).json().catch(() => ({ refused: true }));
    await settled();
    return { p_scene, ...rest };
  };
  await page.waitForFunction(() => document.body.dataset.pictures > 0);
  await until(page, "hint", /: 0 of at least 3/);
  const outside = await page.evaluate(async () => {
    const request = { p_m: [0.9, 0, 1.2], yaw_rad: 0, pitch_rad: 0, fov_deg: 75, width_px: 640, height_px: 400, depth: false };
    const answer = await fetch("/api/align/pick", { method: "POST", body: JSON.stringify({ request, px: [1000, 10] }) });
    return `${answer.status} ${await answer.text()}`;
  });
  assert.match(outside, /^422 the click lies outside/);
  for (const [x, y] of [[420, 780], [860, 780], [560, 640]]) assert.ok((await pick(x, y)).p_scene, `no floor at ${x}, ${y}`);
  await until(page, "verdict", /size not known yet/);
  assert.ok((await pick(840, 640)).p_scene);
  await until(page, "hint", /^4 points/);
  assert.ok(await page.locator("#save").isDisabled(), "without a length nothing is saved");
  await press("one end");
  const one = await pick(420, 780);
  const other = await pick(840, 640);
  // The scene's file is in metres: the true length, as of a tape measure.
  const metres = Math.hypot(...one.p_scene.map((value, k) => value - other.p_scene[k]));
  await page.locator("#metres").fill(metres.toFixed(4));
  await page.locator("#metres").press("Tab");
  await until(page, "verdict", /GO/);
  assert.match(await text(page, "result"), /residual[\s\S]*cm rms[\s\S]*bound[\s\S]*within the fence/);
  await it.shot(page, "align");
  await checkBarriers(page, "the alignment");
  await page.getByLabel("fence to z in metres").fill("3.1");
  await page.getByLabel("fence to z in metres").press("Tab");
  await press("↶ 90°");
  await press("carry along");
  await until(page, "verdict", /GO/);
  await settled();
  const forced = await page.locator("#force").count();
  await page.locator(forced ? "#force" : "#save").click();
  await until(page, "saved", /written .*arena.toml/);
  const written = fs.readFileSync(file, "utf8");
  assert.ok(written.startsWith("# Captured by hand.\n"), written);
  assert.ok(Math.abs(+written.match(/metres_per_unit = ([\d.]+)/)[1] - 1) < 0.01, written);
  const [x, y, z, w] = written.match(/rotation = \[(.*?)\]/)[1].split(",").map(Number);
  // Direction of the file's z axis.
  const up = [2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y)];
  assert.ok(up[2] > Math.cos((0.7 * Math.PI) / 180), `tilted still: ${up}`);
  await it.finish(page);
  server.child.kill("SIGINT");
  await server.ended;
});
