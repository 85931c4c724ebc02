// The reported position of a device as text.
import { formatNumber, text } from "./texts.js";

export function formatPosition(position) {
  if (!position) return "";
  if ("x" in position) {
    const { x, y, heading } = position;
    const place = { x: formatNumber(x, 2), y: formatNumber(y, 2) };
    if (!Number.isFinite(heading)) return text("position.map", place);
    return text("position.map_heading", { ...place, degrees: Math.round((heading * 180) / Math.PI) });
  }
  const { lat, lon, accuracy } = position;
  const place = { lat: formatNumber(lat, 5), lon: formatNumber(lon, 5) };
  return accuracy === null ? text("position.globe", place) : text("position.globe_accuracy", { ...place, metres: formatNumber(accuracy, accuracy < 10 ? 1 : 0) });
}
