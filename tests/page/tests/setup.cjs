// Settings of an instructor before a flight: a camera; light and weather.

const assert = require("node:assert/strict");
const { checkBarriers, isPainted, serverTest, until } = require("../harness.cjs");

serverTest("camera", async (it) => {
  it.command("scene", "generate", "room", "--seed", "1", "-o", it.at("room"));
  const server = await it.serve(it.at("room"), "--leaderboard", "none", "--keys", it.at("keys"));
  const page = await it.open(server.http);
  // Wait until the form shows the camera's settings.
  await until(page, "camera-name", /\d ×/);
  await until(page, "link-text", /live/);
  await page.locator("#setup summary").click();
  await page.locator("#camera-form [name=width_px]").fill("200");
  await page.locator("#camera-form [name=sensor]").selectOption("imx219");
  await page.locator("#camera-form [name=depth_model]").selectOption("d435");
  await page.locator("#camera-form button[type=submit]").click();
  await until(page, "camera-status", /applied/);
  await until(page, "camera-name", /200 ×/);
  await checkBarriers(page, "a camera's settings");
  await it.finish(page);
  await server.end();
});

/** Waits until the mean of the colour image is below this, 0 to 255; returns its brightness. */
const darkerThan = async (page, most) => {
  const found = await page.waitForFunction((most) => {
    const canvas = document.getElementById("colour");
    const { data } = canvas.getContext("2d").getImageData(0, 0, canvas.width, canvas.height);
    const mean = data.reduce((sum, value, k) => sum + (k % 4 < 3 ? value : 0), 0) / (data.length * 0.75);
    return mean < most && [mean];
  }, most);
  return (await found.jsonValue())[0];
};

serverTest("environment", async (it) => {
  it.command("scene", "generate", "room", "--seed", "1", "-o", it.at("room"));
  const server = await it.serve(it.at("room"), "--leaderboard", "none", "--keys", it.at("keys"));
  it.start("sim", "--vicon", server.vicon, "--mavlink", "udpin:127.0.0.1:0", "--spawn", server.spawn.join(), "--json");
  const page = await it.open(server.http);
  await isPainted(page, "colour");
  // Another light is visible in the next images.
  const day = await darkerThan(page, 256);
  await page.locator("#environment").click();
  await page.locator("#environment-choice").selectOption("night");
  await darkerThan(page, 0.6 * day);
  // A name takes effect at once, a visibility with the button; settings without a field are kept.
  /** Waits until the server has the expected settings, and the dialog shows them: until then it would overwrite typed text. */
  const isNow = (...expected) =>
    page.waitForFunction(async (expected) => {
      const now = await (await fetch("/api/environment")).json();
      const [choice, sight] = ["choice", "sight"].map((name) => document.getElementById(`environment-${name}`).value);
      return choice === (now.name ?? "own") && Number(sight) === now.fog_visibility_m
        && expected.every(([path, value]) => path.split(".").reduce((part, key) => part?.[key], now) === value);
    }, expected);
  await page.locator("#environment-choice").selectOption("night-fog");
  await isNow(["name", "night-fog"]);
  assert.equal(await page.locator("#environment-sight").inputValue(), "12");
  await page.locator("#environment-sight").fill("30");
  await page.locator("dialog[open] button[type=submit]").click();
  await isNow(["fog_visibility_m", 30]);
  await page.locator("#environment-choice").selectOption("smoke");
  await isNow(["name", "smoke"]);
  await page.locator("#environment-sight").fill("25");
  await page.locator("dialog[open] button[type=submit]").click();
  await isNow(["fog_visibility_m", 25], ["cloud.visibility_m", 12]);
  await it.shot(page, "environment");
  await checkBarriers(page, "light and weather");
  await page.locator("#environment-choice").selectOption("day");
  await isNow(["name", "day"]);
  await page.locator("dialog[open]").getByRole("button", { name: "close" }).click();
  await page.locator("dialog[open]").waitFor({ state: "hidden" });
  await it.finish(page);
  await server.end();
});
