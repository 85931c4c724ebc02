// Detection: finds the red target in a picture like agents/vision.py, without side effects.
// Red is one corner of YCrCb.  Pixels of the largest red blob are weighted by redness, so soft edges do not matter.
const LOW = [20, 165, 40];
const HIGH = [240, 255, 135];
const GREY = 128;
const BLUR = 2;
const LEAST_AREA = 8;
const SAME_SHAPE = 0.2;
const MOST = 100;

// Browsers do not report the angle of a lens; phones have 60 to 75 degrees across the longer side.
export const LENS = 65 * Math.PI / 180;
export const TARGET = { radius: 0.08, height: 0.22 };

function classifyPixels(pixels, count) {
  const isRed = new Uint8Array(count);
  const redness = new Float32Array(count);
  for (let n = 0; n < count; n += 1) {
    const [r, g, b] = [pixels[4 * n], pixels[4 * n + 1], pixels[4 * n + 2]];
    const y = 0.299 * r + 0.587 * g + 0.114 * b;
    const found = [y, Math.min(255, 0.713 * (r - y) + GREY), Math.min(255, 0.564 * (b - y) + GREY)];
    redness[n] = found[1];
    isRed[n] = found.every((value, each) => value >= LOW[each] && value <= HIGH[each]) ? 1 : 0;
  }
  return { isRed, redness };
}

// The largest blob of neighbours: its area in pixels, its centre, and its bounding box.
function findLargestBlob(isRed, columns, rows) {
  let best = { area: 0 };
  const waiting = [];
  for (let start = 0; start < isRed.length; start += 1) {
    if (!isRed[start]) continue;
    const blob = { area: 0, x: 0, left: columns, top: rows, right: -1, bottom: -1 };
    isRed[start] = 0;
    waiting.push(start);
    while (waiting.length) {
      const at = waiting.pop();
      const x = at % columns;
      const y = (at - x) / columns;
      blob.area += 1;
      blob.x += x;
      [blob.left, blob.right] = [Math.min(blob.left, x), Math.max(blob.right, x)];
      [blob.top, blob.bottom] = [Math.min(blob.top, y), Math.max(blob.bottom, y)];
      for (const [next, isThere] of [[at - 1, x > 0], [at + 1, x < columns - 1], [at - columns, y > 0], [at + columns, y < rows - 1]]) {
        if (!isThere || !isRed[next]) continue;
        isRed[next] = 0;
        waiting.push(next);
      }
    }
    if (blob.area > best.area) best = { ...blob, x: blob.x / blob.area };
  }
  return best;
}

function computePercentile(values, share) {
  const sorted = Float32Array.from(values).sort();
  const at = (sorted.length - 1) * share;
  const below = Math.floor(at);
  return sorted[below] + (sorted[Math.min(below + 1, sorted.length - 1)] - sorted[below]) * (at - below);
}

// The width and height of the blob in pixels, with fractions.
function measureBlob(redness, columns, rows, { left, top, right, bottom }) {
  const [x0, x1] = [Math.max(0, left - BLUR), Math.min(columns - 1, right + BLUR)];
  const [y0, y1] = [Math.max(0, top - BLUR), Math.min(rows - 1, bottom + BLUR)];
  const around = [];
  for (let y = y0; y <= y1; y += 1) for (let x = x0; x <= x1; x += 1) around.push(redness[y * columns + x]);
  const full = Math.max(computePercentile(around, 0.9) - GREY, 1);
  const across = new Float32Array(y1 - y0 + 1);
  const up = new Float32Array(x1 - x0 + 1);
  around.forEach((value, n) => {
    const share = Math.min(1, Math.max(0, (value - GREY) / full));
    if (share < 0.1) return;
    across[Math.floor(n / up.length)] += share;
    up[n % up.length] += share;
  });
  return [Math.max(computePercentile(across, 0.75), 1), Math.max(computePercentile(up, 0.75), 1)];
}

// The target in RGBA pixels: bearing in radians (left positive), distance in metres, and its box in pixels; or null.
export function detectTarget(pixels, columns, rows, size = TARGET, lens = LENS) {
  const { isRed, redness } = classifyPixels(pixels, columns * rows);
  const blob = findLargestBlob(isRed, columns, rows);
  if (blob.area < LEAST_AREA) return null;
  const focal = Math.max(columns, rows) / 2 / Math.tan(lens / 2);
  const bearing = Math.atan2(columns / 2 - (blob.x + 0.5), focal);
  const [across, up] = measureBlob(redness, columns, rows, blob);
  const byWidth = focal * 2 * size.radius / across;
  const byHeight = focal * size.height / up;
  const isWhole = blob.left > 0 && blob.right < columns - 1 && Math.abs(byWidth / byHeight - 1) < SAME_SHAPE;
  // An occluded target looks smaller, never larger, so the smaller estimate is used.
  const distance = (isWhole ? byWidth : Math.min(byWidth, byHeight)) / Math.max(Math.cos(bearing), 0.5);
  const { left, top, right, bottom } = blob;
  return { bearing, distance: Math.min(distance, MOST), isWhole, box: { left, top, width: right - left + 1, height: bottom - top + 1 } };
}
