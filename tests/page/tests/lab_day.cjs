// A lab day: checks change with measurements, and fail while the motion capture pauses; a queue, several vehicles, a
// report.

const assert = require("node:assert/strict");
const { spawnSync } = require("node:child_process");
const fs = require("node:fs");
const path = require("node:path");
const { checkWidth, options, recordedTest, until } = require("../harness.cjs");

recordedTest("lab_day", {
  what: "a lab day with a simulated vehicle that does not take off",
  without: /api\/(map|splats)/,
  async real(it) {
    it.command("scene", "generate", "room", "-o", it.at("room"));
    const arena = it.at("room/arena.toml");
    fs.appendFileSync(arena, '\n[[vehicles]]\nname = "wasp"\n[[vehicles]]\nname = "bee"\n');
    it.server = await it.serve(it.at("room"), "--leaderboard", "none", "--lab-day", it.at("kept.json"), "--keys", it.at("server"),
      "--print-page-keys", "--pair", "instructor");
    const { http, quic, vicon, spawn } = it.server;
    const [, code] = await it.server.line(/"pairing":{"code":"([0-9 ]+)"/);
    [, it.teams] = await it.server.line(/"team of 'wasp'","link":"([^"]+)"/);
    it.command("pair", quic, "--code", code, "--keys", it.at("jetson"));
    it.vehicle = it.start("sim", "--vicon", vicon, "--object", "wasp", "--airframe", "--radio", "--mavlink", "udpin:127.0.0.1:0",
      "--spawn", spawn.join(), "--json");
    const [, mavlink] = await it.vehicle.line(/"mavlink":"([^"]+)"/);
    it.mavlink = `udpout:${mavlink}`;
    // Sets the autopilot's parameters before its runtime uses the link.
    const doctor = (...more) => it.program.run("doctor", "vehicle", "--mavlink", it.mavlink, "--arena", arena, ...more);
    doctor("--apply");
    const { stdout, stderr } = doctor("--report", http, "--vehicle", "wasp");
    assert.match(stdout, /reported http\S+: noted for wasp/, stderr);
    return http;
  },
  async body(it) {
    const page = await it.open(`${it.url}/lab`, { viewport: { width: 1280, height: 720 } });
    const check = (name, of = "wasp") => page.getByRole("region", { name: of ? `checks of ${of}` : "checks of the room" }).locator(`[data-check=${name}]`);
    const stands = (name, state, of) => check(name, of).and(page.locator(`[data-state=${state}]`)).waitFor();
    const reads = (name, pattern) =>
      page.waitForFunction(([name, source]) => new RegExp(source).test(document.querySelector(`[data-check=${name}]`)?.textContent), [name, pattern.source]);
    const press = (name) => page.getByRole("button", { name }).click();
    await it.event("localized", {
      shown: async () => {
        await stands("localization", "ok");
        await stands("network", "not_done");
      },
    });
    await it.event("runtime is there", {
      really: () => (it.fly = it.start("fly", "avoid", "--server", it.server.quic, "--vehicle", "wasp", "--keys", it.at("jetson"),
        "--mavlink", it.mavlink, "--wait", "--json")),
      shown: async () => {
        await page.getByRole("button", { name: "start wasp" }).waitFor();
        for (const name of ["network", "clocks", "battery", "parameters", "fence"]) await stands(name, "ok");
        // Measured at any speed of this computer.
        await reads("latency", /images are \d+ ms old/);
        await reads("fence", /polygons accepted/);
      },
    });
    await page.locator("#signer").fill("Ada Lovelace");
    await press("sign: net closed");
    assert.deepEqual(await it.ordered("POST /api/lab/sign"), { vehicle: "", check: "net", name: "Ada Lovelace", take_back: false });
    await it.event("signed", { shown: () => stands("net", "ok", "") });
    assert.match(await check("net", "").innerText(), /looked at by Ada Lovelace/);
    await press("begin: axes of localization of wasp");
    assert.deepEqual(await it.ordered("POST /api/lab/axes"), { vehicle: "wasp", begin: true });
    await it.event("axes", { shown: () => reads("axes", /do: (put it on the floor|lift it)/) });
    await press("cancel: axes of localization of wasp");
    assert.deepEqual(await it.ordered("POST /api/lab/axes"), { vehicle: "wasp", begin: false });
    // The motion capture pauses: the check fails with instructions, and is ok again afterwards.
    await it.event("capture pauses", {
      really: () => it.vehicle.child.kill("SIGSTOP"),
      shown: async () => {
        await reads("localization", /no pose for[\s\S]*is the localization on/);
        await stands("localization", "failed");
      },
    });
    await it.shot(page, "lab-day-red");
    await it.event("capture is back", { really: () => it.vehicle.child.kill("SIGCONT"), shown: () => stands("localization", "ok") });

    // A team books from its own address, and sees its place; the instructor calls.
    const book = (page, name) => page.locator(`#book-form [name=${name}]`);
    await book(page, "team").fill("cats");
    await book(page, "vehicle").selectOption("wasp");
    await page.locator("#book-form button").click();
    assert.deepEqual(await it.ordered("POST /api/lab/queue"), { team: "cats", vehicle: "wasp" });
    await it.event("cats have booked", { shown: () => until(page, "lab-queue", /1cats/) });
    const team = await it.open(it.teams ?? `${it.url}/lab`, { viewer: "team", viewport: { width: 390, height: 844 } });
    await team.goto(`${it.url}/lab`);
    await book(team, "team").fill("ants");
    await team.locator("#book-form button").click();
    assert.deepEqual(await it.ordered("POST /api/lab/queue"), { team: "ants", vehicle: "wasp" });
    await it.event("ants have booked", {
      shown: async () => {
        await until(team, "lab-status", /place 2 for wasp/);
        await until(team, "lab-queue", /1cats[\s\S]*2ants/);
      },
    });
    assert.ok(await team.locator("#formation").isHidden() && await team.getByRole("button", { name: "sign: LiPo" }).isHidden());
    assert.equal(await team.getByRole("region", { name: "checks of bee" }).count(), 0);
    const call = (words) => press(`${words}, wasp`);
    const turn = async (words, turn) => {
      await call(words);
      assert.deepEqual(await it.ordered("POST /api/lab/turn"), { vehicle: "wasp", turn });
    };
    await turn("call next", "next");
    await it.event("cats are called", { shown: () => until(team, "lab-queue", /nowcats/) });
    await turn("pass over", "pass_over");
    await it.event("cats are passed over", { shown: () => page.getByRole("button", { name: "call next, wasp" }).waitFor() });
    await turn("call next", "next");
    await it.event("ants are called", { shown: () => until(team, "lab-queue", /nowants[\s\S]*1cats/) });

    // The bee takes off first: the wasp's start is rejected with the reason.
    await page.locator("#formation-form [name=order]").fill("bee, wasp");
    await page.locator("#formation-form [name=separation]").fill("1.5");
    await page.locator("#formation-form button").click();
    const { order, separation_m } = await it.ordered("PUT /api/lab/formation");
    assert.deepEqual([order.vehicles, separation_m], [["bee", "wasp"], 1.5]);
    await it.event("in order", { shown: () => until(page, "lab-status", /order of take-off: bee, wasp; 1.5 m apart/) });
    await press("start wasp");
    await it.ordered("POST /api/vehicles/wasp/start");
    await it.event("start is refused", { shown: () => until(page, "lab-status", /'bee' goes before 'wasp' \(bee, wasp\) and is not up yet/) });
    for (const [screen, size] of [[page, [1280, 720]], [page, [390, 844]], [team, [390, 844]]]) {
      await screen.setViewportSize({ width: size[0], height: size[1] });
      await checkWidth(screen, `lab day at ${size}`);
      const stop = await screen.locator("#estop").boundingBox();
      assert.ok(stop.x >= 0 && stop.x + stop.width <= size[0] && stop.y >= 0 && stop.y + stop.height <= size[1] && stop.height >= 44, JSON.stringify(stop));
      await it.shot(screen, `lab-day-${screen === team ? "team-" : ""}${size.join("x")}`);
    }
    // One STOP for all, by the keyboard: on the ground it is the trial of STOP.
    await page.keyboard.press("Escape");
    await it.ordered("POST /api/estop");
    await it.event("stopped", { shown: () => stands("stop", "ok") });
    assert.match(await check("stop").innerText(), /received by the runtime after \d+ ms, landing reported after \d+ ms, disarmed after \d+ ms/);
    await it.really(() => report(it));
    await it.finish(page, team);
    await it.really(() => it.server.end());
  },
});

/** Checks the report as PDF, and in the terminal. */
async function report(it) {
  await it.fly.ended;
  const paper = it.at("day.pdf");
  it.command("lab", "report", "--page", it.url, "--out", paper);
  const words = spawnSync("pdftotext", ["-layout", paper, "-"], { encoding: "utf8" });
  if (!words.error) {
    for (const expected of [/net closed\s+20\d\d-\d\d-\d\d \d\d:\d\d:\d\d UTC/, /looked at by Ada Lovelace/, /ants on wasp\s+booked/,
      /passed over 1 times/, /STOP tried/, /localization live failed/, /page 1 of \d/]) assert.match(words.stdout, expected);
    if (options.shots) spawnSync("pdftoppm", ["-r", "70", "-png", paper, path.join(options.shots, "lab-day-report")]);
  }
  const told = it.program.run("lab", "--page", it.url);
  assert.equal(told.status, 1, "not all checks are done");
  assert.match(told.stdout, /page {5}http\S+\/lab\n[\s\S]*ok {7}the room: net closed[\s\S]*called {3}ants on wasp/);
}
