// The theme: light or dark if the visitor chose one, else the system's choice.
export const KEPT = "swarm.theme";

export function theme() {
  try {
    return /^(light|dark)$/.exec(localStorage.getItem(KEPT))?.[0] ?? "light dark";
  } catch {
    return "light dark";
  }
}

// Set before the first drawing, to avoid a change of colours.
document.documentElement.style.colorScheme = theme();
