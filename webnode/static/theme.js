// The theme: light or dark against the system's choice, where somebody chose one here.
export const KEPT = "swarm.theme";

export function theme() {
  try {
    return /^(light|dark)$/.exec(localStorage.getItem(KEPT))?.[0] ?? "light dark";
  } catch {
    return "light dark";
  }
}

// Before anything is drawn that would change its colours then.
document.documentElement.style.colorScheme = theme();
