// The machine's picture: frames over a websocket of its own, while the page is visible. See machine_camera.py.
(() => {
  "use strict";
  const camera = (window.studioMachine = { frames: 0 });
  let line = null;
  let wanted = false;
  let shown = "";

  function open() {
    if (!wanted || line || document.hidden) return;
    const scheme = location.protocol === "https:" ? "wss" : "ws";
    line = new WebSocket(`${scheme}://${location.host}/studio/machine`);
    line.binaryType = "blob";
    line.onmessage = (event) => {
      const image = document.querySelector(".studio-machine-picture");
      if (typeof event.data === "string") {
        document.querySelector(".studio-machine-told").textContent = event.data;
        return;
      }
      if (!image) return;
      const address = URL.createObjectURL(event.data);
      image.onload = () => {
        if (shown) URL.revokeObjectURL(shown);
        shown = address;
      };
      image.src = address;
      camera.frames += 1;
    };
    line.onclose = () => {
      line = null;
      setTimeout(open, 1000);
    };
  }
  camera.start = () => {
    wanted = true;
    open();
  };
  document.addEventListener("visibilitychange", () => {
    if (document.hidden && line) line.close();
    else open();
  });
})();
