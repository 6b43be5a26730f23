// The wall view: the standings, large, and who flies; asks every second, shows and can do nothing else.

import { $ } from "./dom.js";
import { fetchLeaderboard, fillGrades, fillPlaces, flyingText } from "./standings.js";
import { followTheme } from "./theme.js";

const EVERY_MS = 1000;

async function refresh() {
  try {
    const board = await fetchLeaderboard();
    $("announcement").textContent = board ? "" : "no standings: are runs kept here, and are you logged in?";
    if (board) {
      $("course").textContent = board.course;
      document.title = `${board.course} – VizFlyt leaderboard`;
      fillPlaces($("official"), board.official);
      fillPlaces($("practice"), board.practice);
      fillGrades($("graded"), board.graded);
      $("graded-panel").hidden = !board.graded.length;
      $("flying").textContent = flyingText(board.vehicles);
    }
  } catch {
    $("announcement").textContent = "the server cannot be reached";
  }
  setTimeout(refresh, EVERY_MS);
}
followTheme();
refresh();
