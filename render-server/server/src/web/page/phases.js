// Colours and names of the phases of a flight.

/** @type {Record<string, [tone: string, text: string]>} */
export const PHASES = {
  connecting: ["idle", "connecting"], preparing: ["warn", "preparing"], taking_off: ["go", "taking off"],
  flying: ["good", "flying"], holding: ["warn", "holding"], landing: ["warn", "landing"], landed: ["idle", "landed"],
  waiting: ["go", "ready to start"],
};
