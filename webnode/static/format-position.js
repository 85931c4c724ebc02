// The reported position of a device as text.
export function formatPosition(position) {
  if (!position) return "";
  if ("x" in position) {
    const { x, y, heading } = position;
    const turned = heading === null ? "" : `, heading ${Math.round((heading * 180) / Math.PI)}°`;
    return `${x.toFixed(2)}, ${y.toFixed(2)} m${turned}`;
  }
  const { lat, lon, accuracy } = position;
  return `${lat.toFixed(5)}°, ${lon.toFixed(5)}°${accuracy === null ? "" : `, to ${accuracy < 10 ? accuracy.toFixed(1) : Math.round(accuracy)} m`}`;
}
