// Draws the plots of a page in its colours, light or dark. What is packed is base64 of gzip.
"use strict";
async function unpacked(element) {
  const packed = Uint8Array.from(atob(element.textContent.trim()), letter => letter.charCodeAt(0));
  return new Response(new Blob([packed]).stream().pipeThrough(new DecompressionStream("gzip"))).arrayBuffer();
}

async function runPacked(element) {
  const script = document.createElement("script");
  script.textContent = new TextDecoder().decode(await unpacked(element));
  document.head.append(script);
  script.remove();
}

(async () => {
  const library = document.getElementById("plotly");
  if (!library) return;
  const plots = [...document.querySelectorAll(".plot > div")];
  const colour = name => getComputedStyle(document.documentElement).getPropertyValue(name).trim();

  const narrow = matchMedia("(max-width: 640px)");

  function template() {
    const line = { gridcolor: colour("--row"), zerolinecolor: colour("--line"), linecolor: colour("--line") };
    const axis = { ...line, automargin: true, showline: true, ticks: "outside", tickcolor: colour("--line") };
    return { layout: {
      paper_bgcolor: "#0000", plot_bgcolor: "#0000", colorway: [colour("--ink")], xaxis: axis, yaxis: axis,
      font: { color: colour("--ink"), family: getComputedStyle(document.body).fontFamily, size: 12.5 },
      hoverlabel: { bgcolor: colour("--wash"), bordercolor: colour("--line"), font: { color: colour("--ink") } },
      legend: { orientation: "h", y: 1.02, yanchor: "bottom", x: 0 },
      margin: { l: 56, r: narrow.matches ? 8 : 40, t: 12, b: 44 },  // beside it the mode bar, which phones do not show
      modebar: { bgcolor: "#0000", color: colour("--soft"), activecolor: colour("--ink"), orientation: "v" },
    } };
  }

  const touched = matchMedia("(pointer: coarse)").matches ? { dragmode: false } : {};  // a finger scrolls the page
  try {
    await runPacked(library);
    for (const plot of plots) {
      const { data, layout } = JSON.parse(plot.nextElementSibling.textContent);
      await Plotly.newPlot(plot, data, { ...layout, ...touched, template: template() }, {
        responsive: true, displaylogo: false, plotlyServerURL: "",  // nothing is shared
        modeBarButtons: [layout.scene ? ["orbitRotation", "pan3d", "resetCameraDefault3d", "toImage"]
          : ["zoom2d", "pan2d", "resetScale2d", "toImage"]],
      });
    }
    const redraw = size => plots.forEach(plot => Plotly.relayout(plot, { template: template(), ...size }));
    for (const media of [matchMedia("(prefers-color-scheme: dark)"), narrow]) {
      media.addEventListener("change", () => redraw({}));
    }
    const paper = document.documentElement.classList;
    addEventListener("beforeprint", () => { paper.add("paper"); redraw({ width: 680 }); });
    addEventListener("afterprint", () => { paper.remove("paper"); redraw({ width: null, autosize: true }); });
  } catch (error) {
    for (const plot of plots) plot.textContent = `The plot cannot be drawn here: ${error.message}.`;
  }
})();
