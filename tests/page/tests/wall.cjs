// A team checks in on the page and flies; page and wall show its run, and then its signed grade, without a reload.

const assert = require("node:assert/strict");
const { checkBarriers, checkWidth, isPainted, recordedTest, resize, text, until } = require("../harness.cjs");

recordedTest("wall", {
  what: "a team checks in, flies an official run, and is graded",
  without: /api\/(map|splats)|crash\/\d/,
  async real(it) {
    it.database = it.at("runs.sqlite");
    const file = it.smallRace("race");
    const [token] = it.command("leaderboard", "--database", it.database, "team", "add", "wasps").match(/^[0-9a-f]{32}$/m);
    it.token = token;
    it.server = await it.serve(file, "--leaderboard", it.database, "--keys", it.at("server"), "--pair", "team:vizflyt");
    const [, code] = await it.server.line(/"pairing":{"code":"([0-9 ]+)"/);
    it.command("pair", it.server.quic, "--code", code, "--keys", it.at("jetson"));
    return it.server.http;
  },
  async body(it) {
    const page = await it.open(it.url), wall = await it.open(`${it.url}/wall`);
    const firstRow = (page, id) => page.locator(`#${id} tr`).first().innerText();
    const shows = (page, id, pattern) =>
      page.waitForFunction(([id, source]) => new RegExp(source).test(document.querySelector(`#${id} tr`)?.innerText), [id, pattern.source]);
    await it.event("nobody has flown", { shown: () => shows(wall, "official", /nobody yet/) });
    await page.locator("#leaderboard summary").click();
    await page.locator("#team-form [name=token]").fill("no token of any team");
    await page.locator("#team-form [name=attempt]").selectOption("official");
    await page.locator("#team-form button").click();
    const put = "PUT /api/vehicles/vizflyt/team";
    assert.deepEqual(await it.ordered(put), { token: "no token of any team", attempt: "official" });
    await until(page, "team-status", /no team/);
    const token = it.token ?? "0123456789abcdef";
    await page.locator("#team-form [name=token]").fill(token);
    await page.locator("#team-form button").click();
    assert.deepEqual(await it.ordered(put), { token, attempt: "official" });
    await it.event("checked in", { shown: () => until(page, "checked-in", /wasps flies: official/) });

    const picture = wall.getByRole("region", { name: "who flies now" }).getByRole("figure");
    await it.event("flying", {
      really: async () => {
        const { quic, vicon, spawn } = it.server;
        const vehicle = it.start("sim", "--vicon", vicon, "--mavlink", "udpin:127.0.0.1:0", "--spawn", spawn.join(), "--json");
        const [, mavlink] = await vehicle.line(/"mavlink":"([^"]+)"/);
        it.fly = it.start("fly", "race", "--server", quic, "--keys", it.at("jetson"), "--mavlink", `udpout:${mavlink}`,
          "--seconds", "6", "--log-dir", it.at("flights"), "--json");
      },
      shown: async () => {
        await picture.filter({ hasText: /wasps\s*official\s*\d\/\d\s*0:0\d\.\d/ }).waitFor();
        for (const canvas of ["map", "pictures canvas"]) await isPainted(wall, canvas);
        // The second answer arrives after the first was shown, so the wall has assigned the run.
        for (let k = 0; k < 2; k++) await wall.waitForResponse((answer) => answer.url().endsWith("/api/leaderboard"));
      },
    });
    for (const size of ["phone", "projector", "laptop"]) {
      await resize(wall, size);
      await checkWidth(wall, `wall on ${size}`);
      await it.shot(wall, `${size}-wall-flying`);
    }
    await checkBarriers(wall, "the wall during a flight");
    await it.event("flown", {
      really: async () => assert.equal(await it.fly.ended, 0),
      shown: async () => {
        await picture.waitFor({ state: "detached" });
        // The wall has recorded the best run, which is the ghost of the next ones.
        await until(wall, "ghost", /ghost: the best official run, wasps/);
        // No page is reloaded.
        for (const screen of [wall, page]) await shows(screen, "official", /^1\s+wasps\s+\d\/\d\s/);
      },
    });
    assert.match(await firstRow(wall, "practice"), /nobody yet/);
    assert.ok(await wall.locator("#graded-panel").isHidden(), "no grade exists yet");
    await it.event("graded", {
      really: () => {
        it.command("grade", "race", "--project", "p4", "--seeds", "1", "-o", it.at("grade.json"), "--keys", it.at("grader"));
        it.command("leaderboard", "--database", it.database, "add", it.at("grade.json"), "--team", "wasps", "--keys", it.at("grader"));
      },
      shown: () => wall.locator("#graded-panel").waitFor(),
    });
    assert.match(await text(wall, "graded"), /graded: p4 ug, day[\s\S]*wasps/);
    await checkWidth(wall, "wall");
    await checkBarriers(page, "the leaderboard");
    await checkBarriers(wall, "the wall");
    await it.shot(page, "laptop-leaderboard");
    await it.shot(wall, "wall");
    await it.finish(page, wall);
    await it.really(() => it.server.end());
  },
});
