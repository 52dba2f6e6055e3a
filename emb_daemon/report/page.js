function floats(text, Type) {
  return new Type(Uint8Array.from(atob(text), function (letter) { return letter.charCodeAt(0); }).buffer);
}
// First row at or after a time.
function rowAt(times, time) {
  var low = 0, high = times.length;
  while (low < high) { var middle = (low + high) >> 1; if (times[middle] < time) low = middle + 1; else high = middle; }
  return low;
}
// Rows of a stretch, all of them or the smallest and largest of each bucket.
function rowsOf(values, first, last, points) {
  var rows = [], count = last - first, bucket = Math.max(1, 2 * count / points);
  for (var number = 0, start = first, end; start < last; start = end) {
    end = Math.min(last, first + Math.round(++number * bucket));
    var low = -1, high = -1;
    for (var row = start; row < end; row++) {
      if (isNaN(values[row])) continue;
      if (low < 0 || values[row] < values[low]) low = row;
      if (high < 0 || values[row] > values[high]) high = row;
    }
    if (low < 0) rows.push(start);
    else if (low === high) rows.push(low);
    else rows.push(Math.min(low, high), Math.max(low, high));
  }
  return rows;
}
// Every sample of the traces of a plot that were thinned out.
function detailOf(place) {
  var times = {}, kept = [];
  Object.entries(place.layout.meta || {}).forEach(function (entry) { times[entry[0]] = floats(entry[1], Float64Array); });
  place.data.forEach(function (trace, number) {
    if (trace.meta && trace.meta.values) {
      kept.push({number: number, times: times[trace.meta.times], values: floats(trace.meta.values, Float32Array)});
    }
  });
  return kept;
}
function showDetail(place) {
  var kept = null;
  place.on("plotly_relayout", function (change) {
    if (!Object.keys(change).some(function (key) { return key.startsWith("xaxis"); })) return;
    kept = kept || detailOf(place);
    if (!kept.length) return;
    var range = place._fullLayout.xaxis.range, whole = change["xaxis.autorange"] === true, x = [], y = [];
    kept.forEach(function (trace) {
      var first = whole ? 0 : Math.max(0, rowAt(trace.times, range[0]) - 1);
      var last = whole ? trace.times.length : Math.min(trace.times.length, rowAt(trace.times, range[1]) + 1);
      var rows = rowsOf(trace.values, first, last, POINTS);
      x.push(rows.map(function (row) { return trace.times[row]; }));
      y.push(rows.map(function (row) { return trace.values[row]; }));
    });
    Plotly.restyle(place, {x: x, y: y}, kept.map(function (trace) { return trace.number; }));
  });
}
document.querySelectorAll("[data-figure]").forEach(function (place) {
  var figure = JSON.parse(document.getElementById(place.dataset.figure).textContent);
  Plotly.newPlot(place, figure.data, figure.layout,
    {responsive: true, displaylogo: false, modeBarButtonsToRemove: ["select2d", "lasso2d", "autoScale2d"]});
  showDetail(place);
});
window.addEventListener("beforeprint", function () {
  document.querySelectorAll("[data-figure]").forEach(function (place) { Plotly.Plots.resize(place); });
});
