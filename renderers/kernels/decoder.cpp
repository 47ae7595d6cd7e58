// Values of a ReLU network at points, and their gradients: the features of a tile of points stay in the first caches.
// The same in PyTorch are `BoundDecoder._forward` and `BoundDecoder._backward` in renderers/fields/mlp.py.
#include <cstdint>
#include <cstring>
#include <memory>
#include <utility>

#if defined(__AVX512F__)
constexpr int LANES = 16, VECTORS = 4;  // 24 of 32 registers hold sums
#else
constexpr int LANES = 8, VECTORS = 2;  // 12 of 16
#endif
constexpr int BLOCK = LANES * VECTORS;  // neurons whose weights are contiguous: [outputs / BLOCK][inputs][BLOCK]
constexpr int ROWS = 6;                 // points whose sums are kept in registers
constexpr int TILE = 8 * ROWS;          // points that pass through all layers together

typedef float Vector __attribute__((vector_size(4 * LANES), aligned(4)));

struct Decoder {
  int layers, skip;              // hidden layers; index of the one that also takes the point, 0 for none
  const int *inputs, *outputs;   // of each hidden layer; outputs are a multiple of BLOCK
  const float *const *weights, *const *biases;
  const float *const *transposed;     // of each hidden layer but the first, without the point: [inputs / BLOCK][outputs][BLOCK]
  const float *const *point_weights;  // of the layers that take the point: [3][outputs]; else null
  const float *last;             // weights, as many as the outputs of the last hidden layer
  float last_bias;
};

struct Rows {  // features of points, one row each
  float *start;
  int stride;
  float *at(int row) const { return start + (size_t)row * stride; }
};

// One block of neurons of R points: the sums of their inputs, or with a bias the ReLU of these sums.
template <int R>
static inline void block(Rows from, int inputs, const float *weight, const float *bias, Rows to) {
  Vector sum[R][VECTORS];
  for (int j = 0; j < VECTORS; j++)
    for (int r = 0; r < R; r++) sum[r][j] = bias ? *(const Vector *)(bias + LANES * j) : Vector{};
  for (int k = 0; k < inputs; k++, weight += BLOCK) {
    Vector column[VECTORS];
    for (int j = 0; j < VECTORS; j++) column[j] = *(const Vector *)(weight + LANES * j);
#pragma GCC unroll 6
    for (int r = 0; r < R; r++)
      for (int j = 0; j < VECTORS; j++) sum[r][j] += from.at(r)[k] * column[j];
  }
  for (int r = 0; r < R; r++)
    for (int j = 0; j < VECTORS; j++)  // NaN stays NaN, as in PyTorch
      *(Vector *)(to.at(r) + LANES * j) = bias && sum[r][j] < 0 ? Vector{} : sum[r][j];
}

template <int R>
static void partial_block(int rows, Rows from, int inputs, const float *weight, const float *bias, Rows to) {
  if (rows == R) return block<R>(from, inputs, weight, bias, to);
  if constexpr (R > 1) partial_block<R - 1>(rows, from, inputs, weight, bias, to);
}

static void product(Rows from, int points, int inputs, int outputs, const float *weight, const float *bias, Rows to) {
  for (int o = 0; o < outputs; o += BLOCK, weight += (size_t)BLOCK * inputs)
    for (int r = 0; r < points; r += ROWS)
      partial_block<ROWS>(points - r < ROWS ? points - r : ROWS, {from.at(r), from.stride}, inputs, weight,
                          bias ? bias + o : nullptr, {to.at(r) + o, to.stride});
}

// The features of a hidden layer; those of the layer before are `from`, which the point follows if the layer takes it.
static void layer(const Decoder *net, int index, Rows tile, int points, Rows from, Rows to) {
  if (index == 0)
    from = tile;
  else if (index == net->skip)
    for (int r = 0; r < points; r++) memcpy(from.at(r) + net->inputs[index] - 3, tile.at(r), 3 * sizeof(float));
  product(from, points, net->inputs[index], net->outputs[index], net->weights[index], net->biases[index], to);
}

static int tile_stride(const Decoder *net) {
  int width = 0;
  for (int l = 0; l < net->layers; l++) width = net->outputs[l] > width ? net->outputs[l] : width;
  return width + LANES;  // the point follows the features
}

static float dot(const float *a, const float *b, int width, float sum) {
  Vector sums = {};
  for (int k = 0; k < width; k += LANES) sums += *(const Vector *)(a + k) * *(const Vector *)(b + k);
  for (int j = 0; j < LANES; j++) sum += sums[j];
  return sum;
}

extern "C" int decoder_block() { return BLOCK; }

extern "C" void decoder_values(const Decoder *net, float *points, int64_t count, float *values) {
  int stride = tile_stride(net), width = net->outputs[net->layers - 1];
  std::unique_ptr<float[]> buffer(new float[2 * (size_t)TILE * stride]);
  for (int64_t first = 0; first < count; first += TILE) {
    int rows = count - first < TILE ? (int)(count - first) : TILE;
    Rows tile = {points + 3 * first, 3}, from = {buffer.get(), stride}, to = {from.at(TILE), stride};
    for (int l = 0; l < net->layers; l++) {
      layer(net, l, tile, rows, from, to);
      std::swap(from, to);
    }
    for (int r = 0; r < rows; r++) values[first + r] = dot(from.at(r), net->last, width, net->last_bias);
  }
}

// Adds, for a tile of points, the gradients of their values to those of the points, and to those of the biases of each
// layer whose `to_biases` is not null. `buffer` has room for the features of all layers, and for two gradients.
static void tile_gradients(const Decoder *net, Rows tile, int rows, const float *to_values, Rows buffer, Rows to_points,
                           float *const *to_biases) {
  int stride = buffer.stride, last = net->layers - 1;
  auto features = [&](int l) { return Rows{buffer.at(l * TILE), stride}; };
  for (int l = 0; l <= last; l++) layer(net, l, tile, rows, features(l ? l - 1 : 0), features(l));
  Rows from = features(last + 1), to = features(last + 2);
  for (int r = 0; r < rows; r++)
    for (int k = 0; k < net->outputs[last]; k += LANES)
      *(Vector *)(from.at(r) + k) = to_values[r] * *(const Vector *)(net->last + k);
  for (int l = last;; l--) {
    int width = net->outputs[l];
    for (int k = 0; k < width; k += LANES) {
      Vector sum = {};
      for (int r = 0; r < rows; r++) {
        Vector *gradient = (Vector *)(from.at(r) + k);
        sum += *gradient = *(const Vector *)(features(l).at(r) + k) > 0 ? *gradient : 0 * *gradient;  // NaN stays NaN
      }
      if (to_biases[l]) *(Vector *)(to_biases[l] + k) += sum;
    }
    for (int c = 0; net->point_weights[l] && c < 3; c++)
      for (int r = 0; r < rows; r++)
        to_points.at(r)[c] = dot(from.at(r), net->point_weights[l] + (size_t)c * width, width, to_points.at(r)[c]);
    if (l == 0) return;
    product(from, rows, width, net->outputs[l - 1], net->transposed[l], nullptr, to);
    std::swap(from, to);
  }
}

// From the gradients of values, of which those that are 0 cost nothing, to the gradients of points and biases: see
// `tile_gradients`. The features are computed again.
extern "C" void decoder_gradients(const Decoder *net, const float *points, int64_t count, const float *to_values,
                                  float *to_points, float *const *to_biases) {
  int stride = tile_stride(net);
  std::unique_ptr<float[]> buffer(new float[(net->layers + 2) * (size_t)TILE * stride]);
  for (int64_t next = 0; next < count;) {
    int64_t index[TILE];
    float tile[TILE][3], value_gradients[TILE], point_gradients[TILE][3] = {};
    int rows = 0;
    for (; next < count && rows < TILE; next++)
      if (to_values[next] != 0) {
        index[rows] = next, value_gradients[rows] = to_values[next];
        memcpy(tile[rows++], points + 3 * next, 3 * sizeof(float));
      }
    tile_gradients(net, {*tile, 3}, rows, value_gradients, {buffer.get(), stride}, {*point_gradients, 3}, to_biases);
    for (int r = 0; r < rows; r++) memcpy(to_points + 3 * index[r], point_gradients[r], 3 * sizeof(float));
  }
}
