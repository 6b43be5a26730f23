// Table of all panels of the page. A panel creates its own element; the page puts it in a column, and calls those of
// the functions below that it defines.

import { arenaView } from "./panels/arena_view.js";
import { cameraImages } from "./panels/camera_images.js";
import { cameraSettings } from "./panels/camera_settings.js";
import { crashCard } from "./panels/crash_card.js";
import { events } from "./panels/events.js";
import { figures } from "./panels/figures.js";
import { leaderboard } from "./panels/leaderboard.js";
import { sensors } from "./panels/sensors.js";
import { timing } from "./panels/timing.js";

/**
 * Receiver of the server's messages.
 * @typedef {object} Part
 * @property {(arena: import("./messages").Arena) => void} [onArena] the vehicle, its room and course; first on each connection
 * @property {(cameras: import("./messages").Camera[]) => void} [onCameras] after a change
 * @property {(points: import("./messages").Track["points"], vehicle: string) => void} [onTrack] the track flown before
 * the page was opened, of each vehicle
 * @property {(events: import("./messages").EventLine[]) => void} [onEvents] new events, or repeated earlier ones
 * @property {(state: import("./messages").State) => void} [onState] 20 times a second
 * @property {(kind: number, camera: number, jpeg: Uint8Array<ArrayBuffer>) => void} [onImage] kind: 0 colour, 1 depth, 2 objects
 * @property {(now_ms: number) => void} [onFrame] before the screen is painted
 * @property {() => void} [onTheme] after a change of the style sheet's colours
 *
 * @typedef {Part & { element: HTMLElement }} Panel
 */

/** Panels by column and name, from top to bottom; `dialogs/panels.js` applies this browser's layout. */
export const PANELS = {
  left: { map: arenaView, crash: crashCard, timing, figures },
  right: { cameras: cameraImages, "camera settings": cameraSettings, sensors, leaderboard, events },
};
