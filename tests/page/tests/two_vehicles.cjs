// A first-time user watches two vehicles: selects the other one, finds the cause of its crash, starts the first one and
// stops it. Both are on the map and in the 3D view at the same time. All elements are found by their visible names.

const assert = require("node:assert/strict");
const fs = require("node:fs");
const { INTO_THE_WALL, checkBarriers, recordedTest } = require("../harness.cjs");

recordedTest("two_vehicles", {
  what: "two vehicles over one server: bee flies into a wall, wasp hovers and is stopped by hand",
  without: /api\/(map|splats|shell)|crash\/\d/,
  async real(it) {
    const file = it.smallRace("race");
    const vehicle = (name, y_m) => `\n[[vehicles]]\nname = "${name}"\nspawn = { position_m = [0.9, ${y_m}, 0], yaw_deg = 0 }\n`;
    fs.appendFileSync(file, vehicle("wasp", 1.2) + vehicle("bee", 0));
    it.server = await it.serve(file, "--leaderboard", "none", "--keys", it.at("server"), "--pair", "instructor");
    const { http, quic, vicon } = it.server;
    const [, code] = await it.server.line(/"pairing":{"code":"([0-9 ]+)"/);
    it.command("pair", quic, "--code", code, "--keys", it.at("jetson"));
    it.fly = async (name, y_m, how, ...more) => {
      const sim = it.start("sim", "--object", name, "--vicon", vicon, "--mavlink", "udpin:127.0.0.1:0", "--spawn", `0.9,${y_m},0,0`, "--json");
      const [, mavlink] = await sim.line(/"mavlink":"([^"]+)"/);
      return it.start("fly", it.program.misbehave, "--vehicle", name, "--server", quic, "--keys", it.at("jetson"),
        "--mavlink", `udpout:${mavlink}`, "--log-dir", it.at("flights"), "--json", ...more, "--", how);
    };
    it.wasp = await it.fly("wasp", 1.2, "hover", "--wait");
    return http;
  },
  async body(it) {
    const page = await it.open(it.url);
    const banner = page.getByRole("banner");
    await it.event("opened", {
      shown: async () => {
        await banner.getByText("race", { exact: true }).waitFor();
        await banner.getByText(/ready to start|preparing|no runtime/).waitFor();
        await page.getByRole("button", { name: /^STOP wasp/ }).waitFor();
      },
    });
    const other = page.getByRole("button", { name: /^2 bee/ });
    await it.event("bee flies", { really: async () => (it.bee = await it.fly("bee", 0, INTO_THE_WALL)), shown: () => other.waitFor() });
    for (const view of ["space", "top"]) {
      await page.getByRole("button", { name: view, exact: true }).click();
      await other.waitFor();
      await page.getByText(/^1 wasp/).waitFor();
      await it.shot(page, `laptop-two-${view}`);
    }
    await checkBarriers(page, "two vehicles");
    await it.event("bee has landed", { shown: () => page.getByRole("button", { name: /bee · landed/ }).waitFor() });
    const way = page.waitForURL(/vehicle=bee/);
    await other.click();
    await way;
    const card = page.getByRole("region", { name: "Collision" });
    await it.event("bee is shown", {
      shown: async () => {
        await page.getByRole("button", { name: /^STOP bee/ }).waitFor();
        await card.waitFor();
      },
    });
    assert.match(await card.getByRole("paragraph").first().innerText(), /.{20}/);
    // Back, by the number on the tag.
    await page.keyboard.press("1");
    await page.waitForURL(/vehicle=wasp/);
    await it.event("wasp is shown", { shown: () => page.getByRole("button", { name: "start" }).waitFor() });
    await page.getByRole("button", { name: "start" }).click();
    await it.ordered("POST /api/vehicles/wasp/start");
    await it.event("wasp takes off", { shown: () => banner.getByText(/taking off|holding|flying/).waitFor() });
    await it.event("wasp flies", { shown: () => banner.getByText(/holding|flying/).waitFor() });
    await page.getByRole("button", { name: /^STOP wasp/ }).click();
    await it.ordered("POST /api/vehicles/wasp/estop");
    await it.event("wasp is stopped", { shown: () => page.getByRole("alert").getByText("Stopped by hand").waitFor() });
    assert.deepEqual(it.orders.map(({ order }) => order), ["POST /api/vehicles/wasp/start", "POST /api/vehicles/wasp/estop"]);
    await it.finish(page);
    await it.really(async () => {
      await it.wasp.ended;
      await it.bee.ended;
      await it.server.end();
    });
  },
});
