// Watching: what is asked again and again, but only while somebody looks at where it is shown.

// Calls `work` every so many milliseconds while `root` is in sight; call what it returns to end that.
export function watch(root, every, work) {
  let inSight = false;
  let timer = null;

  function turn() {
    clearTimeout(timer);
    timer = null;
    if (!inSight || document.hidden) return;
    timer = setTimeout(turn, every);
    work();
  }

  const eye = new IntersectionObserver(([entry]) => {
    inSight = entry.isIntersecting;
    if (inSight !== Boolean(timer)) turn();
  });
  eye.observe(root);
  document.addEventListener("visibilitychange", turn);
  return () => {
    inSight = false;
    eye.disconnect();
    document.removeEventListener("visibilitychange", turn);
    turn();
  };
}
