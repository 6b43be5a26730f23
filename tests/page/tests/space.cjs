// The 3D view: the twin's splats, and the server's images of the twin for browsers that are slow or have no WebGL 2.

const assert = require("node:assert/strict");
const { PATIENCE_MS, checkAccess, checkBarriers, resize, serverTest, until } = require("../harness.cjs");

/** Starts a server with a vehicle on the ground. */
async function standing(it, scene) {
  it.command("scene", "generate", ...scene, "-o", it.at("scene"));
  const server = await it.serve(it.at("scene"), "--leaderboard", "none", "--keys", it.at("keys"));
  it.start("sim", "--vicon", server.vicon, "--mavlink", "udpin:127.0.0.1:0", "--spawn", server.spawn.join(), "--json");
  return server;
}

serverTest("space", async (it) => {
  const server = await standing(it, ["room", "--seed", "1"]);
  const page = await it.open(server.http);
  await until(page, "poses", /^\d+$/);
  // Drawn, and rotated by keys.
  const twin = page.waitForResponse((answer) => answer.url().includes("/api/splats/0"));
  await page.locator("#view-space").click();
  const canvas = page.locator("#space");
  await canvas.waitFor({ state: "visible" });
  const began_ms = Date.now();
  do {
    assert.ok(Date.now() - began_ms < PATIENCE_MS, "the view in space stays blank");
    await page.evaluate(() => new Promise((done) => requestAnimationFrame(() => requestAnimationFrame(done))));
  } while ((await canvas.screenshot()).length < 20_000);
  // The twin replaces the boxes; without a graphics card, only its first part is loaded.
  assert.equal((await twin).status(), 200);
  await canvas.press("ArrowLeft");
  await it.shot(page, "laptop-space");
  for (const view of ["chase", "onboard"]) {
    await page.locator(`#view-${view}`).click();
    await page.locator(`#view-${view}[aria-pressed=true]`).waitFor();
    await it.shot(page, `laptop-${view}`);
  }
  await page.locator("#view-top").click();
  await it.finish(page);
  await server.end();
});

/** Waits until the 3D view shows an image of the scene that differs from the previous one; returns colours of its points. */
const served = (page, before = "") =>
  page.waitForFunction((before) => {
    const canvas = document.getElementById("space");
    const g = canvas?.getContext("2d");
    if (!canvas?.width || !g) return false;
    const { data } = g.getImageData(0, 0, canvas.width, canvas.height);
    const seen = [], step = 4 * Math.ceil(data.length / 4 / 2000);
    for (let k = 0; k < data.length; k += step) seen.push((data[k] << 16) | (data[k + 1] << 8) | data[k + 2]);
    // Lines, faces and a background have some tens of colours.
    return new Set(seen).size > 200 && seen.join() !== before && seen.join();
  }, before).then((handle) => handle.jsonValue());

serverTest("without_webgl", async (it) => {
  const server = await standing(it, ["race"]);
  const page = await it.open(server.http, { browser: await it.launch("--no-sandbox", "--disable-3d-apis") });
  await until(page, "poses", /^\d+$/);
  await page.locator("#view-top[aria-pressed=true]").waitFor();
  await page.locator("#view-space").click();
  await page.getByText("drawn by the server: this browser has no WebGL 2").waitFor();
  let before = await served(page);
  await page.locator("#space").focus();
  const answered = page.waitForResponse((answer) => answer.url().includes("/api/twin?"));
  for (let k = 0; k < 8; k++) await page.keyboard.press("ArrowRight");
  assert.equal((await answered).headers()["content-type"], "image/jpeg");
  before = await served(page, before);
  await page.locator("#view-onboard").click();
  await served(page, before);
  await page.locator("#view-space").click();
  await checkBarriers(page, "the server's picture");
  for (const size of ["phone", "laptop"]) {
    await resize(page, size);
    await served(page);
    await checkAccess(page, size);
    await it.shot(page, `${size}-served`);
  }
  await it.finish(page);
  await server.end();
});

serverTest("graphics_fail", async (it) => {
  const server = await standing(it, ["race"]);
  // Small, because the processor draws every pixel.
  const page = await it.open(server.http, { viewport: { width: 800, height: 600 } });
  await until(page, "poses", /^\d+$/);
  await page.locator("#view-space").click();
  // The first request determines a canvas's kind of context: it must come from the page.
  await page.waitForFunction(() => !document.getElementById("space").hidden);
  await page.evaluate(() => document.getElementById("space").getContext("webgl2").getExtension("WEBGL_lose_context").loseContext());
  await page.getByText("drawn by the server: this browser's graphics have failed").waitFor();
  await served(page);
  // From here on the page draws too slowly, even on a fast computer.
  await page.evaluate(() => {
    const request = globalThis.requestAnimationFrame.bind(globalThis);
    globalThis.requestAnimationFrame = (draw) => setTimeout(() => request(draw), 150);
  });
  await page.getByRole("button", { name: "draw here" }).click();
  await page.getByRole("button", { name: "let the server draw" }).click();
  await page.getByText("drawn by the server, twice a second at most").waitFor();
  await served(page);
  await page.getByRole("button", { name: "draw here" }).click();
  await page.getByText("drawn by the server").waitFor({ state: "hidden" });
  await page.waitForFunction(() => document.getElementById("space").getContext("webgl2"));
  await it.finish(page);
  await server.end();
});
